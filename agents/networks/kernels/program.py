"""The learner's kernels for the GPU as one program, what they ask of tensors, and their launch."""

from pathlib import Path

import torch

from megastep.arrdict import arrdict
from megastep.kernels.build.compile import BLOCK, EngineError, Program
from megastep.kernels.build.launch import builders, fields_of, launch

HERE = Path(__file__).parent
DTYPES = {torch.float32: "float32", torch.bfloat16: "bfloat16"}
# By operation, the struct of params.h that it is given.
STRUCTS = {
    "lstm_start": "LstmStartParams",
    "lstm_forward": "LstmForwardParams",
    "lstm_backward": "LstmBackwardParams",
    "mingru_forward": "MingruForwardParams",
    "mingru_backward": "MingruBackwardParams",
}
# Fused multiply-adds and numbers below 1e-38 flushed to zero: no bits have to agree here.
FLAGS = ("--std=c++17", "--ftz=true", "--generate-line-info", f"-DBLOCK={BLOCK}")
CORES = Program(
    HERE, tuple(f"{name}_{dtype}" for name in STRUCTS for dtype in DTYPES.values()), FLAGS
)
params = builders(fields_of(HERE))


def run(operation: str, dtype: torch.dtype, state: torch.Tensor, **given) -> None:
    """Launches an operation that computes in `dtype`, for all lanes and units of a state (B, W).
    The rest is what its struct holds: tensors for pointers, None for a null one, and numbers.
    """
    if dtype not in DTYPES:
        raise EngineError(
            f"The recurrent cores' kernels compute in float32 or bfloat16, not in {dtype}: choose "
            f"one of them for autocast."
        )
    n_lanes, width = state.shape
    n_units = 1 if width % 4 else 4
    fields = {name: _field(value) for name, value in given.items()}
    build = getattr(params, STRUCTS[operation])
    launch(
        f"{operation}_{DTYPES[dtype]}",
        build(**fields, n_lanes=n_lanes, width=width, n_units=n_units),
        state.device,
        n_lanes * width // n_units,
        program=CORES,
    )


def _field(value):
    if isinstance(value, torch.Tensor):
        return value.data_ptr()
    return 0 if value is None else value


def aligned(tensor: torch.Tensor) -> torch.Tensor:
    """The tensor as kernels read it: contiguous, from a multiple of 16 bytes on."""
    if tensor.data_ptr() % 16:
        return tensor.clone(memory_format=torch.contiguous_format)
    return tensor.contiguous()


def check_shapes(
    x: torch.Tensor, reset: torch.Tensor, state: arrdict, leaves: tuple[str, ...]
) -> None:
    """ValueError unless `reset` and the leaves of a state fit x (T, B, W), T at least 1: kernels
    would read past the end of what is too small, or in another device's memory.
    """
    if not len(x):
        raise ValueError(f"x is {tuple(x.shape)}, but a sequence has at least one step")
    expected = {"reset": (reset, x.shape[:2])}
    expected |= {f"state.{name}": (state[name], x.shape[1:]) for name in leaves}
    for name, (given, shape) in expected.items():
        if given.shape != shape or given.device != x.device:
            raise ValueError(
                f"{name} is {tuple(given.shape)} on {given.device}, but x asks for {tuple(shape)} "
                f"on {x.device}"
            )
