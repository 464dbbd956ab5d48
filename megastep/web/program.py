"""Programs: launches of kernels, and the memory that they read and write."""

import ctypes
import functools
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch

from megastep.kernels.build.compile import cpu
from megastep.kernels.build.kernel_library import KernelLibrary


class Word(NamedTuple):
    """A pointer or number of a struct."""

    name: str  # of the field, such as `radius`, or `scenery.radius` in a struct that is a field
    kind: str  # its format, of the module struct
    offset: int  # in bytes, with pointers of this machine


@functools.cache
def words(library: KernelLibrary, operation: str) -> list[Word]:
    """Returns all pointers and numbers of an operation's struct, those of structs that are fields
    too. Where pointers take 4 bytes, as in WebAssembly, a struct is an array of them, 4 bytes each.
    """
    return [*_words(library.structs[library.cpu_operations[operation]])]


def _words(layout, title="", start=0) -> Iterator[Word]:
    for name, kind in layout._all_fields_:
        at = start + getattr(layout, name).offset
        if issubclass(kind, ctypes.Array):
            one: Any = kind._type_
            for k in range(ctypes.sizeof(kind) // ctypes.sizeof(one)):
                yield from _words(one, f"{title}{name}.{k}.", at + k * ctypes.sizeof(one))
        elif issubclass(kind, ctypes.Structure):
            yield from _words(kind, f"{title}{name}.", at)
        else:
            yield Word(title + name, kind._type_, at)


class Ref(NamedTuple):
    """A place in a program's memory: the index of a buffer, and bytes from its start."""

    buffer: int
    offset: int = 0


class Launch(NamedTuple):
    """A launch of an operation of a library."""

    library: KernelLibrary
    operation: str
    values: dict[str, int | float | Ref | None]  # by word of its struct; None for a null pointer


class Buffer(NamedTuple):
    """A part of a program's memory."""

    n_bytes: int
    contents: bytes | None = None  # what it holds at the start; None: anything
    is_float: bool = False  # that is float32 alone


class Leaf(NamedTuple):
    """A tensor in a program's memory."""

    ref: Ref  # the place of its first number
    shape: tuple[int, ...]  # (B, ...)
    strides: tuple[int, ...]  # numbers between neighbours along each axis
    dtype: torch.dtype


@dataclass
class Program:
    """An environment, and what acts in it, as launches."""

    actions: Leaf  # that a step takes, (B, ...)
    buffers: list[Buffer] = field(default_factory=list)
    #: Such as `reset`, `step` and `policy`.
    sections: dict[str, list[Launch]] = field(default_factory=dict)
    #: (from, to), whole buffers that are copied after `reset`.
    copies: list[tuple[int, int]] = field(default_factory=list)
    #: {dotted path: leaf} of the world that a step returns.
    world: dict[str, Leaf] = field(default_factory=dict)

    def add(self, tensor: torch.Tensor) -> Ref:
        """Adds a buffer with a tensor's numbers. Returns its place."""
        contents = tensor.contiguous().numpy().tobytes()
        self.buffers.append(Buffer(tensor.nbytes, contents, tensor.dtype == torch.float32))
        return Ref(len(self.buffers) - 1)

    @property
    def launches(self) -> Iterable[Launch]:
        """All launches of all sections."""
        return (launch for section in self.sections.values() for launch in section)

    def operations(self) -> dict[KernelLibrary, list[str]]:
        """Returns the operations that are launched, by library."""
        found: dict[KernelLibrary, dict[str, None]] = {}
        for launch in self.launches:
            found.setdefault(launch.library, {})[launch.operation] = None
        return {library: [*names] for library, names in found.items()}


class Replay:
    """Runs a program with the CPU's kernels. Memory that holds anything at the start is zeros."""

    def __init__(self, program: Program):
        self.program = program
        self.memory = [bytearray(one.contents or bytes(one.n_bytes)) for one in program.buffers]
        self._addresses = [
            ctypes.addressof((ctypes.c_char * max(len(part), 1)).from_buffer(part)) if part else 0
            for part in self.memory
        ]
        self._calls = {
            name: [self._call(launch) for launch in launches]
            for name, launches in program.sections.items()
        }

    def run(self, section: str) -> None:
        """Runs the launches of a section, and after `reset` the copies."""
        for function, packed in self._calls[section]:
            function(packed)
        for source, target in self.program.copies if section == "reset" else ():
            self.memory[target][:] = self.memory[source]

    def tensor(self, leaf: Leaf) -> torch.Tensor:
        """Returns a leaf as a tensor that shares its memory."""
        flat = torch.frombuffer(self.memory[leaf.ref.buffer], dtype=torch.uint8)
        numbers = flat[leaf.ref.offset % leaf.dtype.itemsize :]
        size = len(numbers) // leaf.dtype.itemsize * leaf.dtype.itemsize
        numbers = numbers[:size].view(leaf.dtype)
        return numbers.as_strided(leaf.shape, leaf.strides, leaf.ref.offset // leaf.dtype.itemsize)

    def world(self) -> Mapping[str, torch.Tensor]:
        """Returns the leaves of the world by path."""
        return {path: self.tensor(leaf) for path, leaf in self.program.world.items()}

    def _call(self, launch: Launch) -> tuple[Callable[[bytes], None], bytes]:
        library, name, values = launch
        layout = words(library, name)
        end = max(word.offset + struct.calcsize(word.kind) for word in layout)
        packed = bytearray(-8 * (-end // 8))
        for word in layout:
            value = values[word.name]
            if isinstance(value, Ref):
                value = self._addresses[value.buffer] + value.offset
            value = 0 if value is None else value
            struct.pack_into(word.kind, packed, word.offset, value)
        return cpu(library)[name], bytes(packed)
