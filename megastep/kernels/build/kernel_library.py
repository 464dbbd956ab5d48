"""A folder of kernels, compiled together for the CPU and for the GPU, and what is read from its
sources, so that structs, constants and operations are declared once:

* structs whose names end in ``Params``, one field per line: ``const float* positions;``, or an
  array of such structs: ``LeafParams leaves[LEAVES];``. A struct may begin with the fields of
  another: ``struct PongParams : StepParams {``
* constants that are plain numbers, one per line: ``constexpr int MAX_RES = 1024;``
* operations, each at the start of a line: ``KERNEL render(RenderParams p)``; for a GPU,
  ``INSTANCE(physics, PhysicsParams, ...)``; in a header, for both, ``EACH(`` or ``EACH_WARP(``
"""

import ctypes
import re
import struct
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

#: The folder of the engine's kernels. Its headers in ``common/`` are for all kernel libraries.
KERNELS = Path(__file__).parents[1]
#: The C++ compiler's flags. No fused multiply-adds, as below.
CPU_FLAGS = (
    *("-std=c++17", "-O3", "-march=native", "-ffp-contract=off", "-fno-tree-slp-vectorize"),
    *("-fno-math-errno", "-fno-trapping-math", "-fopenmp", "-shared", "-fPIC"),
)
#: clang's flags for WebAssembly: as the CPU's, with one thread, small, vectors of 128 bits; never
#: relaxed ones, whose results depend on the processor.
WASM_FLAGS = (
    *("--target=wasm32-wasi", "-std=c++17", "-Os", "-ffp-contract=off", "-fno-math-errno"),
    *("-fno-trapping-math", "-fopenmp-simd", "-fno-exceptions", "-fno-rtti", "-w", "-msimd128"),
)
#: NVRTC's flags, without the architecture. No fused multiply-adds and IEEE division, so that the
#: GPU computes the same bits as the CPU.
CUDA_FLAGS = (
    *("--std=c++17", "--fmad=false", "--prec-div=true", "--prec-sqrt=true", "--ftz=false"),
    "--generate-line-info",
)
#: NVRTC's flags where no bits have to agree: fused multiply-adds, and subnormals flushed to zero.
FAST_CUDA_FLAGS = ("--std=c++17", "--ftz=true", "--generate-line-info")

CONSTANT = re.compile(r"^constexpr (int|float) (\w+) = (-?[\d.]+(?:e-?\d+)?)f?;", re.M)
STRUCT = re.compile(r"^struct (\w+Params)(?: : (\w+Params))? \{(.*?)^\};", re.M | re.S)
FIELD = re.compile(r"(?:const )?([\w ]+?)\s*(\*?)\s*\b(\w+)(?:\[(\d+)\])?")
OPERATION = re.compile(
    r"^(?:KERNEL|(INSTANCE|EACH|EACH_WARP)\()\s*(?:\w+\([\w, ]+\) )?(\w+)(?:, |\((?:const )?)"
    r"(\w+Params)\b(?:\s*&?\s*\w+\)\s*\{\s*(wait_for_previous\(\)\s*;)?)?",
    re.M,
)
COMMENT = re.compile(r"//.*|/\*[\s\S]*?\*/")
TYPES: Any = {"int": ctypes.c_int, "float": ctypes.c_float, "unsigned int": ctypes.c_uint}
#: The source of a function that packs a struct.
PACKED = """
def packed(**values):
    if len(values) == len(names):
        try:
            return pack({})
        except KeyError:
            pass
    for field in sorted(names ^ values.keys()):
        problem = "needs the field" if field in names else "has no field"
        raise TypeError(f"{{name}} {{problem}} '{{field}}'")
"""


class KernelLibrary:
    """The kernels in one folder, which are built together when one is first launched.

    The folder holds operations: for the CPU in ``.cpp`` files, for the GPU in ``.cu`` files, or for
    both as EACH in a header, which nothing else includes. Headers declare the struct of each
    launch, and constants. Sources include the folder's headers by name and the common ones as
    ``"common/errors.h"``.

    Args:
        folder: where the sources are.
        cuda_flags: NVRTC's flags, without the architecture.
        cpu_flags: the C++ compiler's flags.

    Attributes:
        constants: {name: number} of the folder's and the common headers.
        structs: {struct: its layout in memory}, each ``...Params`` in the headers. Others that it
            holds, or begins with, are declared before it. ValueError if a field cannot be packed.
        params: functions that pack a struct: ``params.RowParams(n=64, ...)``.
        cpu_operations, cuda_operations: {operation: struct} for the CPU and the GPU.
        early_operations: those that a GPU may start before the previous kernel has ended: their
            first statement, in each definition behind ``#if``, is ``wait_for_previous();``.
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
        found = CONSTANT.findall("\n".join(self.sources(".h").values()))
        return {
            name: int(number) if kind == "int" else float(number) for kind, name, number in found
        }

    @cached_property
    def structs(self) -> dict[str, type[ctypes.Structure]]:
        found: dict[str, Any] = {}
        for header, text in self.sources(".h").items():
            text = re.sub(r"\[(\w+)", lambda at: f"[{self.constants.get(at[1], at[1])}", text)
            for name, base, body in STRUCT.findall(COMMENT.sub("", text)):
                parent: Any = found[base] if base else ctypes.Structure
                own: list[tuple[str, Any]] = []
                for line in body.split(";")[:-1]:
                    match = FIELD.fullmatch(line.strip())
                    kind = ctypes.c_void_p if match and match[2] else None
                    kind = kind or match and (TYPES.get(match[1]) or found.get(match[1]))
                    if not match or not kind or match[4] and match[1] not in found:
                        raise ValueError(
                            f"{header}: cannot pack the field '{' '.join(line.split())}'. A field "
                            "is a pointer, an int, an unsigned int, a float, or a struct ...Params "
                            "declared above or an array of them."
                        )
                    own.append((match[3], kind * int(match[4]) if match[4] else kind))
                # with those that it begins with
                fields = [*getattr(parent, "_all_fields_", ()), *own]
                found[name] = type(name, (parent,), {"_fields_": own, "_all_fields_": fields})
        return found

    @cached_property
    def params(self) -> SimpleNamespace:
        packers = {name: packer(layout) for name, layout in self.structs.items()}
        return SimpleNamespace(**packers)

    @cached_property
    def cpu_operations(self) -> dict[str, str]:
        return {one[2]: one[3] for one in kernels(self.sources(".h", ".cpp"))}

    @cached_property
    def cuda_operations(self) -> dict[str, str]:
        return {one[2]: one[3] for one in kernels(self.sources(".h", ".cu"))}

    @cached_property
    def early_operations(self) -> frozenset[str]:
        found = kernels(self.sources(".h", ".cu"))
        late = {one[2] for one in found if not one[1] and not one[4]}
        return frozenset(one[2] for one in found) - late

    def sources(self, *suffixes: str) -> dict[str, str]:
        """Returns the text of the files with these suffixes, by the name that includes them.

        The common headers come first, as ``common/...``; then the folder's own files.
        """
        files = {f"common/{path.name}": path for path in sorted((KERNELS / "common").iterdir())}
        files |= {path.name: path for path in sorted(self.folder.iterdir())}
        return {name: path.read_text() for name, path in files.items() if path.suffix in suffixes}


def kernels(sources: Mapping[str, str]) -> list[re.Match[str]]:
    """Returns matches of `OPERATION` in sources {name: text}: [2] is the name, [3] the struct."""
    return [one for text in sources.values() for one in OPERATION.finditer(COMMENT.sub("", text))]


def packer(layout: Any) -> Callable[..., bytes]:
    """Returns a function of a struct's fields that packs one, or raises a TypeError unless it gets
    each field, and no other. A pointer is a tensor, an address, or None for null. An array is
    the joined bytes of its structs; those that are missing at its end are zeros.
    """
    address = "x if (x := values[{!r}]).__class__ is int else 0 if x is None else x.data_ptr()"
    items, kinds, end = [], "", 0
    for name, kind in layout._all_fields_:
        at, size = getattr(layout, name).offset, ctypes.sizeof(kind)
        character = (
            f"{size}s" if issubclass(kind, (ctypes.Array, ctypes.Structure)) else kind._type_
        )
        items.append(address.format(name) if character == "P" else f"values[{name!r}]")
        kinds += f"{at - end}x{character}"
        end = at + size
    pack = struct.Struct(f"{kinds}{ctypes.sizeof(layout) - end}x").pack
    names = dict(layout._all_fields_).keys()
    scope: dict = dict(name=layout.__name__, names=names, pack=pack)
    exec(PACKED.format(", ".join(items)), scope)  # a loop over the fields would slow launches down
    return scope["packed"]
