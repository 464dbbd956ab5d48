"""A folder of kernels, compiled together for the CPU and for the GPU, and what is read from its
sources, so that structs, constants and operations are declared once:

* structs whose names end in ``Params``, one field per line: ``const float* positions;``, or an
  array of such structs: ``LeafParams leaves[4];``. A struct may begin with the fields of another:
  ``struct PongParams : StepParams {``
* constants that are plain numbers, one per line: ``constexpr int MAX_RES = 1024;``
* operations, each at the start of a line: ``KERNEL render(RenderParams p)``; for a GPU,
  ``INSTANCE(spawn, SpawnParams, ...)``; in a header, for CPU and GPU, ``EACH(uniform, ...)``
"""

import ctypes
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

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

CONSTANT = re.compile(r"^constexpr (int|float) (\w+) = (-?[\d.]+(?:e-?\d+)?)f?;", re.M)
STRUCT = re.compile(r"^struct (\w+Params)(?: : (\w+Params))? \{(.*?)^\};", re.M | re.S)
FIELD = re.compile(r"(?:const )?([\w ]+?)\s*(\*?)\s*\b(\w+)(?:\[(\d+)\])?")
OPERATION = re.compile(
    r"^(?:KERNEL|(INSTANCE|EACH)\()\s*(?:BOUNDS\(\d+\) )?(\w+)(?:, |\((?:const )?)(\w+Params)\b"
    r"(?:\s*&?\s*\w+\)\s*\{\s*(wait_for_previous\(\)\s*;)?)?",
    re.M,
)
TYPES: dict[str, Any] = {"int": ctypes.c_int, "float": ctypes.c_float}
TYPES["unsigned int"] = ctypes.c_uint
#: The source of a function of {field: value} that packs a struct.
PACKED = """
def packed(values):
    if len(values) == len(names):
        try:
            return pack({})
        except KeyError:
            pass
    for field in sorted(names ^ values.keys()):
        problem = "needs the field" if field in names else "has no field"
        raise TypeError(f"{{name}} {{problem}} '{{field}}'")
"""


class Word(NamedTuple):
    """A pointer or number of a struct."""

    name: str  # of the field, such as `radius`, or `scenery.radius` in a struct that is a field
    kind: str  # its format, of the module struct
    offset: int  # in bytes, with pointers of this machine


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
        structs: {struct: its layout in memory}.
        words: {struct: all its pointers and numbers}, those of structs that are fields too. Where
            pointers take 4 bytes, as in WebAssembly, a struct is an array of them, 4 bytes each.
        packers: {struct: function of {field: value} that packs one}.
        params: the same by keywords; ``params.RowParams(n=64, ...)`` packs one that is a field of
            another.
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
        return structs(self.sources(".h"))

    @cached_property
    def words(self) -> dict[str, list[Word]]:
        return {name: [*_words(layout)] for name, layout in self.structs.items()}

    @cached_property
    def packers(self) -> dict[str, Callable[[Mapping[str, object]], bytes]]:
        return {name: packer(layout) for name, layout in self.structs.items()}

    @cached_property
    def params(self) -> SimpleNamespace:
        packed = {name: partial(_pack, packer) for name, packer in self.packers.items()}
        return SimpleNamespace(**packed)

    @cached_property
    def cpu_operations(self) -> dict[str, str]:
        return operations(self.sources(".h", ".cpp"))

    @cached_property
    def cuda_operations(self) -> dict[str, str]:
        return operations(self.sources(".h", ".cu"))

    @cached_property
    def early_operations(self) -> frozenset[str]:
        kernels = [*_kernels(self.sources(".h", ".cu"))]
        late = {kernel[2] for kernel in kernels if not kernel[1] and not kernel[4]}
        return frozenset(kernel[2] for kernel in kernels) - late

    def sources(self, *suffixes: str) -> dict[str, str]:
        """Returns the text of the files with these suffixes, by the name that includes them.

        The common headers come first, as ``common/...``; then the folder's own files.
        """
        files = {f"common/{path.name}": path for path in sorted((KERNELS / "common").iterdir())}
        files |= {path.name: path for path in sorted(self.folder.iterdir())}
        return {name: path.read_text() for name, path in files.items() if path.suffix in suffixes}


def _pack(packer, /, **fields) -> bytes:
    return packer(fields)


def operations(sources: Mapping[str, str]) -> dict[str, str]:
    """Returns {operation: name of its struct} of what these sources {name: text} define."""
    return {kernel[2]: kernel[3] for kernel in _kernels(sources)}


def _kernels(sources) -> Iterator[re.Match[str]]:
    for text in sources.values():
        yield from OPERATION.finditer(_without_comments(text))


def structs(sources: Mapping[str, str]) -> dict[str, type[ctypes.Structure]]:
    """Returns every struct ``...Params`` in the headers ``sources`` {name: text}. Others that it
    holds, or begins with, are declared before it. ValueError if a field cannot be packed.
    """
    found: dict[str, Any] = {}
    for header, text in sources.items():
        for name, base, body in STRUCT.findall(_without_comments(text)):
            fields = [_field(line, header, found) for line in body.split(";")[:-1]]
            parent = found[base] if base else ctypes.Structure
            found[name] = type(name, (parent,), {"_fields_": fields})
    return found


def _field(line, header, known) -> tuple[str, Any]:
    match = FIELD.fullmatch(line.strip())
    of_name = ctypes.c_void_p if match and match[2] else None
    of_name = of_name or match and (TYPES.get(match[1]) or known.get(match[1]))
    if not match or not of_name or match[4] and match[1] not in known:
        raise ValueError(
            f"{header}: cannot pack the field '{' '.join(line.split())}'. A field is a pointer, "
            f"an int, an unsigned int, a float, or a struct ...Params declared above or an array "
            f"of them."
        )
    return match[3], of_name * int(match[4]) if match[4] else of_name


def _fields(layout) -> list[tuple[str, Any]]:
    """Returns [(name, type)] of a struct's fields, those that it begins with first."""
    return [field for part in layout.__mro__[::-1] for field in vars(part).get("_fields_", ())]


def _words(layout, title="", start=0) -> Iterator[Word]:
    for name, kind in _fields(layout):
        at = start + getattr(layout, name).offset
        if issubclass(kind, ctypes.Array):
            one: Any = kind._type_
            for k in range(ctypes.sizeof(kind) // ctypes.sizeof(one)):
                yield from _words(one, f"{title}{name}.{k}.", at + k * ctypes.sizeof(one))
        elif issubclass(kind, ctypes.Structure):
            yield from _words(kind, f"{title}{name}.", at)
        else:
            yield Word(title + name, kind._type_, at)


def packer(layout: type[ctypes.Structure]) -> Callable[[Mapping[str, object]], bytes]:
    """Returns a function of {field: value} that packs a struct, or raises a TypeError unless it
    gets each field, and no other. A pointer is a tensor, an address, or None for null. An array is
    the joined bytes of its structs; those that are missing at its end are zeros.
    """
    address = "x if (x := values[{!r}]).__class__ is int else 0 if x is None else x.data_ptr()"
    items, kinds, end = [], "", 0
    for name, kind in _fields(layout):
        at, size = getattr(layout, name).offset, ctypes.sizeof(kind)
        character = (
            f"{size}s" if issubclass(kind, (ctypes.Array, ctypes.Structure)) else kind._type_
        )
        items.append(address.format(name) if character == "P" else f"values[{name!r}]")
        kinds += f"{at - end}x{character}"
        end = at + size
    pack = struct.Struct(f"{kinds}{ctypes.sizeof(layout) - end}x").pack
    names = dict(_fields(layout)).keys()
    scope: dict = dict(name=layout.__name__, names=names, pack=pack)
    exec(PACKED.format(", ".join(items)), scope)  # a loop over the fields would slow launches down
    return scope["packed"]


def _without_comments(text) -> str:
    return re.sub(r"//.*|/\*[\s\S]*?\*/", "", text)
