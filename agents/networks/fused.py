"""Operations with a fused form: a kernel that computes what takes PyTorch several operations.

An operation is written in PyTorch, which runs everywhere. The first kernel before it that takes the
arguments computes it. `plain_operations` asks for PyTorch's form, such as for exporters.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch

from megastep.arrdict import arrdict
from megastep.kernels.build import kernel_library
from megastep.kernels.build.compile import EngineError, cpu
from megastep.kernels.build.kernel_library import KernelLibrary

# Unlike in the engine, no bits have to agree: fused multiply-adds.
_CPU_FLAGS = tuple(
    flag.replace("contract=off", "contract=fast") for flag in kernel_library.CPU_FLAGS
)
#: The kernels of the networks, for CPU and GPU.
LIBRARY = KernelLibrary(
    Path(__file__).parent / "kernels", kernel_library.FAST_CUDA_FLAGS, _CPU_FLAGS
)
#: Dtypes that the recurrent cores' kernels compute in, and how kernels are named for them.
DTYPES = {torch.float32: "float32", torch.bfloat16: "bfloat16"}
#: Names of the operations that have a fused form, such as `returns.gae`.
OPERATIONS: set[str] = set()
uses_gpu = torch.cuda.is_initialized
#: Those that run in their plain form.
_plain: frozenset[str] = frozenset()

Operation = Callable[..., Any]


def fused(
    kernel: Operation,
    fits: Callable[..., bool],
    on_cpu: bool = False,
    operation: Operation | None = None,
) -> Any:
    """Decorates an operation in PyTorch: `kernel` computes the same from the same arguments, if
    `fits` returns that it takes them. Only where a GPU is in use, unless it runs `on_cpu` too.
    """
    if operation is None:
        return functools.partial(fused, kernel, fits, on_cpu)
    name = f"{operation.__module__.rpartition('.')[2]}.{operation.__qualname__}"
    OPERATIONS.add(name)

    @functools.wraps(operation)
    def chosen(*args, **options) -> object:
        is_possible = name not in _plain and (on_cpu or uses_gpu())
        if is_possible and fits(*args, **options):
            return kernel(*args, **options)
        return operation(*args, **options)

    return chosen


@contextlib.contextmanager
def plain_operations(*names: str) -> Iterator[None]:
    """Computes operations in their plain form inside the context: some of `OPERATIONS`, or all."""
    global _plain
    before, _plain = _plain, frozenset(names or OPERATIONS)
    try:
        yield
    finally:
        _plain = before


@functools.cache
def is_built_for_cpu() -> bool:
    """Returns whether there are kernels for the CPU, which takes a C++ compiler."""
    try:
        return bool(cpu(LIBRARY))
    except EngineError:
        return False


def is_plain_on_gpu(*tensors: torch.Tensor) -> bool:
    """Returns whether tensors are float32, contiguous and on a GPU."""
    return all(x.is_cuda and x.dtype == torch.float32 and x.is_contiguous() for x in tensors)


def has_hopper(device: torch.device, n_bytes: int) -> bool:
    """Returns whether a GPU is a Hopper or later, with so many bytes of shared memory per block."""
    gpu = torch.cuda.get_device_properties(device)
    return gpu.major >= 9 and gpu.shared_memory_per_block_optin >= n_bytes


def aligned(tensor: torch.Tensor) -> torch.Tensor:
    """Returns the tensor, or a copy, contiguous and starting at a multiple of 16 bytes."""
    if tensor.data_ptr() % 16:
        return tensor.clone(memory_format=torch.contiguous_format)
    return tensor.contiguous()


def aligned_rows(matrix: torch.Tensor) -> torch.Tensor:
    """Returns the matrix, or a copy if rows are not contiguous or start at odd addresses."""
    n_rows, n_columns = matrix.shape
    n_bytes = matrix.stride(0) * matrix.element_size()
    is_apart = n_rows > 1 and matrix.stride(0) >= n_columns and not n_bytes % 16
    if is_apart and matrix.stride(1) == 1 and not matrix.data_ptr() % 16:
        return matrix
    return aligned(matrix)


def check_shapes(x: torch.Tensor, reset: torch.Tensor, state: arrdict) -> None:
    """Raises ValueError unless x is (T, B, W), T > 0, and reset (T, B) and the state's leaves
    (B, W) are on its device: kernels would read out of bounds.
    """
    if _plain == OPERATIONS:  # such as for an exporter, which does not know the number of lanes
        return
    if not len(x):
        raise ValueError(f"x is {tuple(x.shape)}, but a sequence has at least one step")
    states = [(f"state.{name}", leaf, x.shape[1:]) for name, leaf in state.items()]
    for name, tensor, shape in [("reset", reset, x.shape[:2]), *states]:
        if tensor.shape != shape or tensor.device != x.device:
            raise ValueError(
                f"{name} is {tuple(tensor.shape)} on {tensor.device}, but x asks for "
                f"{tuple(shape)} on {x.device}"
            )
