"""The kernel library of the networks, for CPU and GPU, and helpers of its wrappers."""

import contextlib
import functools
from collections.abc import Iterator
from pathlib import Path

import torch

from megastep.arrdict import arrdict
from megastep.kernels.build import kernel_library
from megastep.kernels.build.compile import EngineError, cpu
from megastep.kernels.build.kernel_library import KernelLibrary

DTYPES = {torch.float32: "float32", torch.bfloat16: "bfloat16"}
# Unlike in the engine, no bits have to agree: fused multiply-adds.
CPU_FLAGS = tuple(
    flag.replace("contract=off", "contract=fast") for flag in kernel_library.CPU_FLAGS
)
LIBRARY = KernelLibrary(Path(__file__).parent, kernel_library.FAST_CUDA_FLAGS, CPU_FLAGS)


def units_per_thread(width: int) -> int:
    """Returns how many neighbouring units a thread of a recurrent core's kernel has."""
    return 1 if width % 4 else 4


def kernel(operation: str, dtype: torch.dtype) -> str:
    """Returns the name of the kernel that does an operation, such as `lstm_start`, in a dtype.

    Raises:
        EngineError: if there is none.
    """
    if dtype not in DTYPES:
        raise EngineError(
            f"The recurrent cores' kernels compute in float32 or bfloat16, not in {dtype}: choose "
            f"one of them for autocast."
        )
    return f"{operation}_{DTYPES[dtype]}"


def sizes(state: torch.Tensor) -> dict[str, int]:
    """Returns the fields of a struct about the size of a state (B, W)."""
    n_lanes, width = state.shape
    return dict(n_lanes=n_lanes, width=width, n_units=units_per_thread(width))


def n_threads(state: torch.Tensor) -> int:
    """Returns how many threads handle all lanes and units of a state (B, W)."""
    return state.numel() // units_per_thread(state.shape[1])


#: Whether everything is computed by PyTorch's operations, which other runtimes have.
_is_plain = False


@contextlib.contextmanager
def plain_operations() -> Iterator[None]:
    """Has a CPU compute by PyTorch's operations alone for the duration of the context."""
    global _is_plain
    before, _is_plain = _is_plain, True
    try:
        yield
    finally:
        _is_plain = before


def is_plain() -> bool:
    """Returns whether `plain_operations` asks for operations that change nothing in place."""
    return _is_plain


def is_built_for_cpu() -> bool:
    """Returns whether the CPU's operations can be used, which takes a C++ compiler."""
    return not _is_plain and _is_built()


@functools.cache
def _is_built() -> bool:
    try:
        return bool(cpu(LIBRARY))
    except EngineError:
        return False


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
