"""Launches a program's operation on the device where its tensors are."""

import ctypes
import functools
from collections.abc import Mapping
from typing import Any

import torch

from megastep.kernels.build.compile import EngineError, bindings, check_status, cpu, cuda
from megastep.kernels.build.program import KERNELS, Program

__all__ = ["ENGINE", "addresses", "launch", "launch_blocks"]

#: The engine's operations.
ENGINE = Program(KERNELS)
BLOCK = ENGINE.constants["BLOCK"]  # threads per block
WARP = ENGINE.constants["WARP"]
INVALID_CONTEXT = 201  # CUDA_ERROR_INVALID_CONTEXT
MAX_THREADS = 2**32 - BLOCK  # per launch: kernels count them in 32 bits
USUAL_SHARED = 48 * 1024  # bytes of dynamic shared memory that any kernel may have
_ALLOWED_SHARED: dict[tuple[Any, int], int] = {}  # {(kernel, GPU): bytes} of those that have more


def addresses(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Returns fields of a struct with the address of each tensor in its place, and 0 for None."""
    values = {name: 0 if field is None else field for name, field in fields.items()}
    return {
        name: value.data_ptr() if isinstance(value, torch.Tensor) else value
        for name, value in values.items()
    }


def launch(
    program: Program,
    operation: str,
    packed: bytes,
    device: torch.device,
    threads: int,
    shared: int = 0,
) -> None:
    """Runs an operation of a program: on a CPU before this returns, on a GPU on the current stream.

    Args:
        program: its kernels are built if this is its first launch on the device.
        operation: the kernel's name.
        packed: its struct, from ``program.params``.
        device: where its tensors are.
        threads: number of GPU threads, rounded up to whole blocks. The CPU ignores it.
        shared: dynamic shared memory in bytes per warp, on a GPU.

    Raises:
        EngineError: if the program has no such operation for the device, or it cannot be built.
    """
    if device.type == "cpu":
        _operation(cpu(program), operation, program, ".cpp", "a GPU (device=cuda)")(packed)
        return
    if not threads:
        return
    check_n_threads(operation, threads, device)
    n_blocks = -(-threads // BLOCK)
    launch_blocks(program, operation, packed, device, (n_blocks, 1), BLOCK, shared * BLOCK // WARP)


def check_n_threads(operation: str, n: int, device: torch.device) -> None:
    """Checks the number of threads of a launch.

    Raises:
        EngineError: if there are too many.
    """
    if n > MAX_THREADS:
        raise EngineError(
            f"{operation} needs {n:,} threads on {device}, but a launch has at most "
            f"{MAX_THREADS:,}: use fewer environments."
        )


def launch_blocks(
    program: Program,
    operation: str,
    packed: bytes,
    device: torch.device,
    n_blocks: tuple[int, int],
    n_threads: int,
    shared: int = 0,
) -> None:
    """Runs an operation of a program on a GPU's current stream, with blocks of any size.

    Args:
        program: its kernels are built if this is its first launch on the device.
        operation: the kernel's name.
        packed: its struct, from ``program.params``.
        device: where its tensors are.
        n_blocks: along x and y.
        n_threads: per block.
        shared: dynamic shared memory in bytes per block.

    Raises:
        EngineError: if the program has no such operation for the device, or it cannot be built.
    """
    index = torch.cuda.current_device() if device.index is None else device.index
    function = _operation(cuda(program, index), operation, program, ".cu", "a CPU (device=cpu)")
    arguments = (ctypes.c_char_p * 1)(packed)
    with torch.cuda.device(index):
        if shared > USUAL_SHARED:
            _allow_shared(function, shared, index)
        driver, _ = bindings()
        stream = torch.cuda.current_stream(index).cuda_stream
        is_early = operation in program.early_operations and _can_start_early(index)
        config = _config(n_blocks, n_threads, shared, stream, is_early)
        call = config, function, ctypes.addressof(arguments), 0
        status = driver.cuLaunchKernelEx(*call)
        if int(status[0]) == INVALID_CONTEXT:
            make_current(index)
            status = driver.cuLaunchKernelEx(*call)
    check_status(status, f"Launching {operation}")


@functools.cache
def _can_start_early(index: int) -> bool:
    """Returns whether a GPU has programmatic dependent launch."""
    return torch.cuda.get_device_capability(index) >= (9, 0)


@functools.lru_cache(maxsize=1024)  # making one takes as long as a third of a launch
def _config(
    n_blocks: tuple[int, int], n_threads: int, shared: int, stream: int, is_early: bool
) -> Any:
    """Returns what a launch needs beside its kernel and struct.

    Args:
        is_early: whether the kernel may start before the one before it has ended. Only for a
            kernel that waits for that one: nothing else would keep the two apart. If something
            else comes before, such as a copy, an event or a graph, the kernel starts after it.
    """
    driver, _ = bindings()
    config = driver.CUlaunchConfig()
    config.gridDimX, config.gridDimY, config.gridDimZ = *n_blocks, 1
    config.blockDimX, config.blockDimY, config.blockDimZ = n_threads, 1, 1
    config.sharedMemBytes, config.hStream = shared, stream
    if is_early:
        attribute, names = driver.CUlaunchAttribute(), driver.CUlaunchAttributeID
        attribute.id = names.CU_LAUNCH_ATTRIBUTE_PROGRAMMATIC_STREAM_SERIALIZATION
        attribute.value.programmaticStreamSerializationAllowed = 1
        config.attrs, config.numAttrs = [attribute], 1
    return config


def _allow_shared(function: Any, shared: int, index: int) -> None:
    """Lets a kernel have more than the usual shared memory. Never less than it had before."""
    if shared <= _ALLOWED_SHARED.get((function, index), 0):
        return
    driver, _ = bindings()
    make_current(index)
    attribute = driver.CUfunction_attribute.CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES
    check_status(driver.cuFuncSetAttribute(function, attribute, shared), "Reserving shared memory")
    _ALLOWED_SHARED[function, index] = shared


def _operation(functions, name, program, suffix, other):
    try:
        return functions[name]
    except KeyError:
        raise EngineError(
            f"No {suffix} file in {program.folder} defines the operation {name}: add one, or run "
            f"on {other}."
        ) from None


def make_current(index: int) -> None:
    """Makes a GPU's context current in this thread.

    Autograd's threads have no context until PyTorch's first operation there, and the driver, unlike
    the runtime, does not set one.
    """
    driver, _ = bindings()
    device = check_status(driver.cuDeviceGet(index), "Finding the GPU")
    context = check_status(driver.cuDevicePrimaryCtxRetain(device), "Finding the GPU's context")
    check_status(driver.cuCtxSetCurrent(context), "Setting the GPU's context")
