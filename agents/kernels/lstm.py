"""The LSTM on a GPU between its matrix products: a kernel before the first step, one per step, and
one per step back.

Axes: B lanes, W units. All tensors are contiguous, and where W is a multiple of 4 they begin at a
multiple of four elements. Gates, outputs, memories and their gradients are in the compute dtype,
cells in float32, resets bool. Each function writes to the tensors given last.
"""

from pathlib import Path

import torch

from megastep.kernels.compile import BLOCK, EngineError, Program
from megastep.kernels.launch import builders, fields_of, launch

HERE = Path(__file__).parent
DTYPES = {torch.float32: "float32", torch.bfloat16: "bfloat16"}
# Fused multiply-adds and numbers below 1e-38 flushed to zero: no bits have to agree here.
FLAGS = ("--std=c++17", "--ftz=true", "--generate-line-info", f"-DBLOCK={BLOCK}")
LSTM = Program(
    HERE,
    tuple(
        f"lstm_{way}_{name}" for way in ("start", "forward", "backward") for name in DTYPES.values()
    ),
    FLAGS,
)
params = builders(fields_of(HERE))


def _launch(way, build, dtype, cell, **arguments):
    if dtype not in DTYPES:
        raise EngineError(
            f"The LSTM's kernels compute in float32 or bfloat16, not in {dtype}: choose one of "
            f"them for autocast."
        )
    n_lanes, width = cell.shape
    n_units = 1 if width % 4 else 4
    pointers = {
        name: 0 if tensor is None else tensor.data_ptr()
        for name, tensor in dict(arguments, cell=cell).items()
    }
    launch(
        f"lstm_{way}_{DTYPES[dtype]}",
        build(**pointers, n_lanes=n_lanes, width=width, n_units=n_units),
        cell.device,
        n_lanes * width // n_units,
        program=LSTM,
    )


def start(reset, last_output, last_cell, memory, cell):
    """What the first step remembers, (B, W): the last output and cell, or zero where `reset` (B).
    `last_output` is float32.
    """
    _launch(
        "start",
        params.LstmStartParams,
        memory.dtype,
        cell,
        reset=reset,
        last_output=last_output,
        last_cell=last_cell,
        memory=memory,
    )


def forward(gates, cell, next_reset, output, next_memory, next_cell):
    """From the gates before their activation (B, 4 W) and the cell (B, W) to the output, and to the
    output and the cell as the next step remembers them: zero where `next_reset` (B). If there is no
    next step, `next_reset` and `next_memory` are None.
    """
    _launch(
        "forward",
        params.LstmForwardParams,
        gates.dtype,
        cell,
        gates=gates,
        next_reset=next_reset,
        output=output,
        next_memory=next_memory,
        next_cell=next_cell,
    )


def backward(gates, cell, next_reset, d_output, d_next_memory, d_next_cell, d_gates, d_cell):
    """The gradients of `forward` in its gates and its cell, from those in what it gave."""
    _launch(
        "backward",
        params.LstmBackwardParams,
        gates.dtype,
        cell,
        gates=gates,
        next_reset=next_reset,
        d_output=d_output,
        d_next_memory=d_next_memory,
        d_next_cell=d_next_cell,
        d_gates=d_gates,
        d_cell=d_cell,
    )
