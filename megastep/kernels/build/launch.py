"""Launches an operation of a kernel library on the device where its tensors are."""

import contextlib
import ctypes
import functools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch

from megastep.kernels.build.compile import EngineError, bindings, check_status, cpu, cuda
from megastep.kernels.build.kernel_library import KERNELS, KernelLibrary

#: The engine's operations.
ENGINE = KernelLibrary(KERNELS)
BLOCK = ENGINE.constants["BLOCK"]  # threads per block
WARP = ENGINE.constants["WARP"]
INVALID_CONTEXT = 201  # CUDA_ERROR_INVALID_CONTEXT
USUAL_SHARED = 48 * 1024  # bytes of dynamic shared memory that any kernel may have
#: {(kernel, GPU): bytes} of those that have more.
_ALLOWED_SHARED: dict[tuple[object, int], int] = {}
Observer = Callable[[KernelLibrary, str, bytes], None]
#: What is told of launches on a CPU.
_OBSERVERS: list[Observer] = []
#: How many `without_early_starts` are open, in all threads.
_n_without_early_starts = 0


class Blocks(NamedTuple):
    """The blocks of a launch on a GPU."""

    x: int  # number of blocks along each axis
    y: int = 1
    threads: int = BLOCK  # of a block
    shared: int = 0  # dynamic shared memory of a block, in bytes


def launch(
    library: KernelLibrary,
    operation: str,
    device: torch.device,
    shape: int | Blocks,
    /,
    **fields: object,
) -> None:
    """Runs an operation of a kernel library, which is built if need be, where its tensors are: on a
    CPU before this returns, on a GPU on the current stream.

    Args:
        shape: number of GPU threads, rounded up to whole blocks of `BLOCK`; or the `Blocks`. A GPU
            does nothing if there are none. A CPU ignores it.
        fields: all fields of the operation's struct. A pointer is a tensor, an address, or None for
            null.

    Raises:
        EngineError: if the library has no such operation for the device, it cannot be built, or
            the GPU refuses the launch.
        TypeError: if a field is missing, or the struct has none of that name.
    """
    is_cpu = device.type == "cpu"
    struct = (library.cpu_operations if is_cpu else library.cuda_operations).get(operation)
    if struct is None:
        suffix, other = (".cpp", "cuda") if is_cpu else (".cu", "cpu")
        raise EngineError(
            f"No {suffix} file in {library.folder} defines the operation {operation}: add one, or "
            f"use device={other}."
        )
    packed = vars(library.params)[struct](**fields)
    if is_cpu:
        for observer in _OBSERVERS:
            observer(library, operation, packed)
        cpu(library)[operation](packed)
        return
    blocks = shape if isinstance(shape, Blocks) else (-(-shape // BLOCK), 1, BLOCK, 0)
    x, y, n_threads, shared = blocks
    if not x * y * n_threads:
        return
    index = torch.cuda.current_device() if device.index is None else device.index
    function = cuda(library, index)[operation]
    arguments = (ctypes.c_char_p * 1)(packed)
    with torch.cuda.device(index):
        if shared > USUAL_SHARED:
            _allow_shared(function, shared, index)
        driver, _ = bindings()
        stream = torch.cuda.current_stream(index).cuda_stream
        is_early = operation in library.early_operations and _can_start_early(index)
        is_early = is_early and not _n_without_early_starts
        call = _config(blocks, stream, is_early), function, ctypes.addressof(arguments), 0
        status = driver.cuLaunchKernelEx(*call)
        if int(status[0]) == INVALID_CONTEXT:
            make_current(index)
            status = driver.cuLaunchKernelEx(*call)
    check_status(status, f"Launching {operation}")


@contextlib.contextmanager
def observed(observer: Observer) -> Iterator[None]:
    """Calls ``observer(library, operation, packed struct)`` before each launch on a CPU."""
    _OBSERVERS.append(observer)
    try:
        yield
    finally:
        _OBSERVERS.remove(observer)


@contextlib.contextmanager
def without_early_starts() -> Iterator[None]:
    """Kernels launched or recorded inside, by any thread, start when the one before them has ended.
    Others may start earlier and wait on the GPU, which saves a single stream time. Where many
    streams share a GPU, those that wait take the place of those that could run.
    """
    global _n_without_early_starts
    _n_without_early_starts += 1
    try:
        yield
    finally:
        _n_without_early_starts -= 1


def is_shared() -> bool:
    """Returns whether a `without_early_starts` is open: many streams share the GPU."""
    return _n_without_early_starts > 0


@functools.cache
def _can_start_early(index: int) -> bool:
    """Returns whether a GPU has programmatic dependent launch."""
    return torch.cuda.get_device_capability(index) >= (9, 0)


@functools.lru_cache(maxsize=1024)  # making one takes as long as a third of a launch
def _config(blocks: tuple[int, int, int, int], stream: int, is_early: bool) -> object:
    """Returns what a launch needs beside its kernel and struct. If it ``is_early``, it may start
    before the kernel before it has ended, for which it must wait itself.
    """
    driver, _ = bindings()
    config = driver.CUlaunchConfig()
    x, y, n_threads, shared = blocks
    config.gridDimX, config.gridDimY, config.gridDimZ = x, y, 1
    config.blockDimX, config.blockDimY, config.blockDimZ = n_threads, 1, 1
    config.sharedMemBytes, config.hStream = shared, stream
    if is_early:
        attribute, names = driver.CUlaunchAttribute(), driver.CUlaunchAttributeID
        attribute.id = names.CU_LAUNCH_ATTRIBUTE_PROGRAMMATIC_STREAM_SERIALIZATION
        attribute.value.programmaticStreamSerializationAllowed = 1
        config.attrs, config.numAttrs = [attribute], 1
    return config


def _allow_shared(function: object, shared: int, index: int) -> None:
    """Lets a kernel have more than the usual shared memory. Never less than it had before."""
    if shared <= _ALLOWED_SHARED.get((function, index), 0):
        return
    driver, _ = bindings()
    make_current(index)
    attribute = driver.CUfunction_attribute.CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
    check_status(driver.cuFuncSetAttribute(function, attribute, shared), "Reserving shared memory")
    _ALLOWED_SHARED[function, index] = shared


def make_current(index: int) -> None:
    """Makes a GPU's context current in this thread. Autograd's threads have none until PyTorch's
    first operation there, and the driver, unlike the runtime, does not set one.
    """
    driver, _ = bindings()
    device = check_status(driver.cuDeviceGet(index), "Finding the GPU")
    context = check_status(driver.cuDevicePrimaryCtxRetain(device), "Finding the GPU's context")
    check_status(driver.cuCtxSetCurrent(context), "Setting the GPU's context")
