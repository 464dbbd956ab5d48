"""A folder of kernels, compiled together for the CPU and for the GPU."""

from collections.abc import Callable, Mapping
from functools import cached_property, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from megastep.kernels.build import headers

__all__ = [
    *("CPU_FLAGS", "CUDA_FLAGS", "FAST_CUDA_FLAGS", "KERNELS", "SCALAR_WASM_FLAGS", "WASM_FLAGS"),
    "KernelLibrary",
]

#: The folder of the engine's kernels. Its headers in ``common/`` are for all kernel libraries.
KERNELS = Path(__file__).parents[1]
#: The C++ compiler's flags. No fused multiply-adds, as below.
CPU_FLAGS = (
    *("-std=c++17", "-O3", "-march=native", "-ffp-contract=off", "-fno-tree-slp-vectorize"),
    *("-fno-math-errno", "-fno-trapping-math", "-fopenmp", "-shared", "-fPIC"),
)
#: clang's flags for WebAssembly without vectors. As the CPU's, with one thread, and small.
SCALAR_WASM_FLAGS = (
    *("--target=wasm32-wasi", "-std=c++17", "-Os", "-ffp-contract=off", "-fno-math-errno"),
    *("-fno-trapping-math", "-fopenmp-simd", "-fno-exceptions", "-fno-rtti", "-w"),
)
#: The same with vectors of 128 bits. Never relaxed ones, whose results depend on the processor.
WASM_FLAGS = (*SCALAR_WASM_FLAGS, "-msimd128")
#: NVRTC's flags, without the architecture. No fused multiply-adds and IEEE division, so that the
#: GPU computes the same bits as the CPU.
CUDA_FLAGS = (
    *("--std=c++17", "--fmad=false", "--prec-div=true", "--prec-sqrt=true", "--ftz=false"),
    "--generate-line-info",
)
#: NVRTC's flags where no bits have to agree: fused multiply-adds, and subnormals flushed to zero.
FAST_CUDA_FLAGS = ("--std=c++17", "--ftz=true", "--generate-line-info")


class KernelLibrary:
    """The kernels in one folder, which are built together when one is first launched.

    The folder holds operations: for the CPU in ``.cpp`` files, for the GPU in ``.cu`` files, or for
    both as EACH in a header, which nothing else includes. Headers declare the struct of each
    launch; ``constants.h`` holds what the kernels share with Python. Sources include the folder's
    headers by name and the common ones as ``"common/errors.h"``.
    :mod:`~megastep.kernels.build.headers` lists the declarations that are read from headers.

    Args:
        folder: where the sources are.
        cuda_flags: NVRTC's flags, without the architecture.
        cpu_flags: the C++ compiler's flags.

    Attributes:
        constants: {name: number} from ``constants.h``, the folder's and the common one.
        params: a function for each struct; ``params.RowParams(n=64, ...)`` packs one that is a
            field of another.
        cpu_operations, cuda_operations: {operation: struct} for the CPU and the GPU.
    """

    def __init__(
        self,
        folder: Path | str,
        cuda_flags: tuple[str, ...] = CUDA_FLAGS,
        cpu_flags: tuple[str, ...] = CPU_FLAGS,
    ):
        self.folder, self.cuda_flags, self.cpu_flags = Path(folder), cuda_flags, cpu_flags

    def __repr__(self) -> str:
        return f"KernelLibrary({str(self.folder)!r})"

    @cached_property
    def constants(self) -> dict[str, Any]:
        return headers.constants(self.sources(".h"))

    @cached_property
    def words(self) -> dict[str, list[headers.Word]]:
        """{struct: its pointers and numbers}."""
        return headers.words(self.sources(".h"))

    @cached_property
    def packers(self) -> dict[str, Callable[[Mapping[str, object]], bytes]]:
        """{struct: function of {field: value} that packs one}."""
        structs = headers.struct_fields(self.sources(".h"))
        return {name: headers.builder(name, fields) for name, fields in structs.items()}

    @cached_property
    def params(self) -> SimpleNamespace:
        packed = {name: partial(_pack, packer) for name, packer in self.packers.items()}
        return SimpleNamespace(**packed)

    @cached_property
    def cpu_operations(self) -> dict[str, str]:
        return headers.operations(self.sources(".h", ".cpp"))

    @cached_property
    def cuda_operations(self) -> dict[str, str]:
        return headers.operations(self.sources(".h", ".cu"))

    @cached_property
    def early_operations(self) -> frozenset[str]:
        """Those that a GPU may start before the previous kernel has ended."""
        return headers.early_operations(self.sources(".h", ".cu"))

    def sources(self, *suffixes: str) -> dict[str, str]:
        """Returns the text of the files with these suffixes, by the name that includes them.

        The common headers come first, as ``common/...``; then the folder's own files.
        """
        files = {f"common/{path.name}": path for path in sorted((KERNELS / "common").iterdir())}
        files |= {path.name: path for path in sorted(self.folder.iterdir())}
        return {name: path.read_text() for name, path in files.items() if path.suffix in suffixes}


def _pack(packer, /, **fields) -> bytes:
    return packer(fields)
