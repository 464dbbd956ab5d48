"""Launches an operation on the device where its tensors are, with params that are given by name.

A program's ``params.h`` declares a struct for each operation. The structs are read from there, so
their layout in memory has one home, and ``params.RenderParams(scenery=..., positions=..., ...)``
packs one. All fields are keyword arguments that must be given, so Python itself refuses a misspelt
or a missing one by name. A pointer is a tensor's address; 0 says that it is not wanted.
"""

import ctypes
import re
import struct
from pathlib import Path
from types import SimpleNamespace

import torch

from megastep.kernels.build.compile import BLOCK, ENGINE, EngineError, Program, bindings, checked, cpu, cuda

WARP = 32  # threads
INVALID_CONTEXT = 201  # CUDA_ERROR_INVALID_CONTEXT
MAX_THREADS = 2**32 - BLOCK  # per launch: kernels count them in 32 bits
FORMATS = {"int": "i", "float": "f", "unsigned int": "I"}


def fields_of(folder: Path) -> dict[str, list[tuple[str, str]]]:
    """By struct of the folder's params.h, its fields: (name, format of the module struct)."""
    source = re.sub(r"//.*", "", (folder / "params.h").read_text())
    found = {}
    formats = dict(FORMATS)
    for name, body in re.findall(r"struct (?:alignas\(\d+\) )?(\w+) \{(.*?)\};", source, re.S):
        found[name] = [
            (field, "P" if star else formats[kind.replace("const", "").strip()])
            for kind, star, field in re.findall(r"([\w ]+?)\s*(\*?)\s+(\w+);", body)
        ]
        formats[name] = f"0P{_packer(found[name]).size}s"
    return found


def _packer(fields):
    """``0P`` pads to a pointer's alignment, as a compiler does at the end of such a struct."""
    end = "0P" if any(kind[-1] in "Ps" for _, kind in fields) else ""
    return struct.Struct("".join(kind for _, kind in fields) + end)


def _builder(name, fields):
    """A function of keyword arguments alone, the fields, that gives the struct as bytes."""
    names = ", ".join(field for field, _ in fields)
    made = eval(f"lambda *, {names}: pack({names})", {"pack": _packer(fields).pack})
    made.__name__ = made.__qualname__ = name
    return made


def builders(fields: dict[str, list[tuple[str, str]]]) -> SimpleNamespace:
    """By struct, a function of its fields that packs one."""
    return SimpleNamespace(**{name: _builder(name, own) for name, own in fields.items()})


def sizes_of(fields: dict[str, list[tuple[str, str]]]) -> dict[str, int]:
    """By struct, its bytes."""
    return {name: _packer(own).size for name, own in fields.items()}


FIELDS = fields_of(ENGINE.folder)
SIZES = sizes_of(FIELDS)
params = builders(FIELDS)


def launch(
    operation: str,
    packed: bytes,
    device: torch.device,
    threads: int,
    shared: int = 0,
    program: Program = ENGINE,
) -> None:
    """Runs ``operation`` on its packed params: on the CPU, where there is the engine alone, at
    once; on a GPU in ``threads`` threads on the device's current stream.

    ``shared`` is dynamic shared memory in bytes per warp.
    """
    if device.type == "cpu":
        cpu()[operation](packed)
        return
    if not threads:
        return
    if threads > MAX_THREADS:
        raise EngineError(
            f"{operation} would need {threads:,} threads on {device}, but a launch has at most "
            f"{MAX_THREADS:,}: use fewer environments."
        )
    index = torch.cuda.current_device() if device.index is None else device.index
    function = cuda(index, program)[operation]
    arguments = (ctypes.c_char_p * 1)(packed)
    with torch.cuda.device(index):
        stream = torch.cuda.current_stream(index).cuda_stream
        shape = *(-(-threads // BLOCK), 1, 1), *(BLOCK, 1, 1), shared * (BLOCK // WARP)
        given = function, *shape, stream, ctypes.addressof(arguments), 0
        status = bindings()[0].cuLaunchKernel(*given)
        if int(status[0]) == INVALID_CONTEXT:
            make_current(index)
            status = bindings()[0].cuLaunchKernel(*given)
    checked(status, f"Launching {operation}")


def make_current(index: int) -> None:
    """Makes a GPU's context this thread's. Autograd's threads have none until PyTorch's first
    operation there; the driver, unlike the runtime, does not see to it by itself.
    """
    driver, _ = bindings()
    device = checked(driver.cuDeviceGet(index), "Finding the GPU")
    context = checked(driver.cuDevicePrimaryCtxRetain(device), "Finding the GPU's context")
    checked(driver.cuCtxSetCurrent(context), "Taking the GPU's context")
