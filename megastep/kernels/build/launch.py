"""Launches a program's operation on the device where its tensors are."""

import ctypes

import torch

from megastep.kernels.build.compile import EngineError, bindings, check_status, cpu, cuda
from megastep.kernels.build.program import KERNELS, Program

__all__ = ["ENGINE", "launch"]

#: The engine's operations.
ENGINE = Program(KERNELS)
BLOCK = ENGINE.constants["BLOCK"]  # threads per block
WARP = ENGINE.constants["WARP"]
INVALID_CONTEXT = 201  # CUDA_ERROR_INVALID_CONTEXT
MAX_THREADS = 2**32 - BLOCK  # per launch: kernels count them in 32 bits


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
    if threads > MAX_THREADS:
        raise EngineError(
            f"{operation} needs {threads:,} threads on {device}, but a launch has at most "
            f"{MAX_THREADS:,}: use fewer environments."
        )
    index = torch.cuda.current_device() if device.index is None else device.index
    function = _operation(cuda(program, index), operation, program, ".cu", "a CPU (device=cpu)")
    arguments = (ctypes.c_char_p * 1)(packed)
    with torch.cuda.device(index):
        stream = torch.cuda.current_stream(index).cuda_stream
        shape = *(-(-threads // BLOCK), 1, 1), *(BLOCK, 1, 1), shared * (BLOCK // WARP)
        call = function, *shape, stream, ctypes.addressof(arguments), 0
        status = bindings()[0].cuLaunchKernel(*call)
        if int(status[0]) == INVALID_CONTEXT:
            make_current(index)
            status = bindings()[0].cuLaunchKernel(*call)
    check_status(status, f"Launching {operation}")


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
