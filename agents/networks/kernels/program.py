"""The networks' kernels as one program for the CPU and the GPU, and their launch."""

import functools
from pathlib import Path

import torch

from megastep.arrdict import arrdict
from megastep.engine.devices import threads
from megastep.kernels.build import program
from megastep.kernels.build.compile import EngineError, cpu
from megastep.kernels.build.launch import (
    BLOCK,
    addresses,
    check_n_threads,
    launch,
    launch_blocks,
)
from megastep.kernels.build.program import Program

DTYPES = {torch.float32: "float32", torch.bfloat16: "bfloat16"}
# Unlike in the engine, no bits have to agree: fused multiply-adds, and subnormals flushed to zero.
CUDA_FLAGS = ("--std=c++17", "--ftz=true", "--generate-line-info")
CPU_FLAGS = tuple(flag.replace("contract=off", "contract=fast") for flag in program.CPU_FLAGS)
CPU = torch.device("cpu")
CORES = Program(Path(__file__).parent, CUDA_FLAGS, CPU_FLAGS)


def units_per_thread(width: int) -> int:
    """Returns how many neighbouring units a thread of a recurrent core's kernel has."""
    return 1 if width % 4 else 4


def run(
    operation: str,
    dtype: torch.dtype,
    state: torch.Tensor,
    block: int = BLOCK,
    shared: int = 0,
    **fields,
) -> None:
    """Launches an operation for all lanes and units of a state.

    Args:
        operation: its name without the dtype, such as `lstm_start`.
        dtype: in which it computes.
        state: (B, W).
        block: threads of a block.
        shared: dynamic shared memory in bytes per block.
        fields: the other fields of its struct. A tensor stands for its address, None for null.

    Raises:
        EngineError: if there is no kernel for `dtype`.
    """
    if dtype not in DTYPES:
        raise EngineError(
            f"The recurrent cores' kernels compute in float32 or bfloat16, not in {dtype}: choose "
            f"one of them for autocast."
        )
    n_lanes, width = state.shape
    n_units = units_per_thread(width)
    kernel = f"{operation}_{DTYPES[dtype]}"
    pack = getattr(CORES.params, CORES.cuda_operations[kernel])
    values = addresses(fields)
    packed = pack(**values, n_lanes=n_lanes, width=width, n_units=n_units)
    n_threads = n_lanes * width // n_units
    check_n_threads(operation, n_threads, state.device)
    n_blocks = -(-n_threads // block)
    if n_blocks:
        launch_blocks(CORES, kernel, packed, state.device, (n_blocks, 1), block, shared)


@functools.cache
def is_built_for_cpu() -> bool:
    """Returns whether the CPU's operations can be used, which takes a C++ compiler."""
    try:
        return bool(cpu(CORES))
    except EngineError:
        return False


def run_on_cpu(operation: str, **fields) -> None:
    """Runs an operation of a `.cpp` file with as many threads as the engine has.

    Args:
        operation: its name.
        fields: the fields of its struct but `n_threads`. A tensor stands for its address.
    """
    pack = getattr(CORES.params, CORES.cpu_operations[operation])
    values = addresses(fields)
    packed = pack(**values, n_threads=threads())
    launch(CORES, operation, packed, CPU, 0)


def aligned(tensor: torch.Tensor) -> torch.Tensor:
    """Returns the tensor, or a copy, contiguous and starting at a multiple of 16 bytes."""
    if tensor.data_ptr() % 16:
        return tensor.clone(memory_format=torch.contiguous_format)
    return tensor.contiguous()


def aligned_rows(matrix: torch.Tensor) -> torch.Tensor:
    """Returns the matrix, or `aligned` of it if a row does not start at a multiple of 16 bytes, or
    is not contiguous.
    """
    n_rows, n_columns = matrix.shape
    n_bytes = matrix.stride(0) * matrix.element_size()
    is_apart = n_rows > 1 and matrix.stride(0) >= n_columns and not n_bytes % 16
    if is_apart and matrix.stride(1) == 1 and not matrix.data_ptr() % 16:
        return matrix
    return aligned(matrix)


def check_shapes(
    x: torch.Tensor, reset: torch.Tensor, state: arrdict, leaves: tuple[str, ...]
) -> None:
    """Checks the inputs of a recurrent core, since kernels would read out of bounds.

    Args:
        x: (T, B, W), T at least 1.
        reset: (T, B), on the device of `x`.
        state: whose `leaves` are (B, W), on the device of `x`.
        leaves: names of the leaves to check.

    Raises:
        ValueError: naming the tensor that does not fit `x`.
    """
    if not len(x):
        raise ValueError(f"x is {tuple(x.shape)}, but a sequence has at least one step")
    expected = {"reset": (reset, x.shape[:2])}
    expected |= {f"state.{name}": (state[name], x.shape[1:]) for name in leaves}
    for name, (tensor, shape) in expected.items():
        if tensor.shape != shape or tensor.device != x.device:
            raise ValueError(
                f"{name} is {tuple(tensor.shape)} on {tensor.device}, but x asks for "
                f"{tuple(shape)} on {x.device}"
            )
