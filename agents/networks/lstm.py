"""A long short-term memory (LSTM, Hochreiter and Schmidhuber 1997) whose hidden state is cleared
inside a sequence where an episode starts.

T time, B lanes, W width. Gates are laid out (..., 4 W): input, forget, candidate, output, as in
PyTorch. Matrix products run in the compute dtype (autocast's) on a GPU and in float32 on a CPU. The
cell and its gates are float32 on both: over hundreds of steps a bfloat16 cell would round small
additions away.

`lstm_sequence` is the recurrence in PyTorch. A CPU runs a whole sequence in one kernel, and so does
a GPU with clusters of blocks (Hopper and later). When acting, one kernel does a step (`step.py`).
"""

from pathlib import Path

import torch
from torch import nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from megastep.agents.networks import side_stream, step
from megastep.agents.networks.fused import (
    LIBRARY,
    aligned,
    check_shapes,
    fused,
    has_hopper,
    is_built_for_cpu,
)
from megastep.agents.networks.linear import (
    cast,
    cast_joined,
    compute_dtype,
    gradient_of_inputs,
    gradient_of_weights,
    matmul,
    product,
    sum_rows,
)
from megastep.arrdict import arrdict
from megastep.devices import threads
from megastep.kernels.build.kernel_library import FAST_CUDA_FLAGS, KernelLibrary
from megastep.kernels.build.launch import Blocks, launch

# Lambdas with type parameters are device code only if everything is.
CLUSTERS = KernelLibrary(
    Path(__file__).parent / "kernels" / "clusters",
    (*FAST_CUDA_FLAGS, "--device-as-default-execution-space"),
)
#: Widths that the kernels for clusters have.
WIDTHS = 128, 256
_MAX_STEPS, _THREADS, _LANES, _BLOCK_UNITS = (
    CLUSTERS.constants[name]
    for name in ("MAX_STEPS", "SEQUENCE_THREADS", "SEQUENCE_LANES", "BLOCK_UNITS")
)


def _fits(x, *_) -> bool:
    n_steps, n_lanes, width = x.shape
    if (x.device.type, x.dtype) == ("cpu", torch.float32):
        return width % 16 == 0 and is_built_for_cpu()
    if not x.is_cuda or x.dtype != torch.bfloat16 or width not in WIDTHS or not n_lanes:
        return False
    n_bytes = max(CLUSTERS.constants[f"{way}_MEMORY_{width}"] for way in ("FORWARD", "BACKWARD"))
    # for one step, loading the weights takes too long
    return 2 <= n_steps <= _MAX_STEPS and has_hopper(x.device, n_bytes)


# `_forward_...` returns outputs (T, B, W), each step's recurrent input (T, B, W), the last output
# without a residual and the last cell, (B, W) float32, and what `_backward_...` needs. That returns
# the gradients of the gates (T, B, 4 W), of the bias in rows to be added up (..., 4 W), of the
# output and the cell before the sequence, (B, W), and of the inputs, None if left to the caller.

# ---- On a GPU with clusters of blocks: the recurrent weights stay on the chip ----


def _launch_clusters(direction, width, device, n_lanes, **fields) -> None:
    n_clusters = -(-n_lanes // _LANES)
    shared = CLUSTERS.constants[f"{direction.upper()}_MEMORY_{width}"]
    blocks = Blocks(width // _BLOCK_UNITS * n_clusters, threads=_THREADS, shared=shared)
    fields |= dict(n_lanes=n_lanes, n_clusters=n_clusters)
    launch(CLUSTERS, f"lstm_sequence_{direction}_{width}", device, blocks, **fields)


def _forward_on_clusters(
    x, input_weight, bias, weight, reset, output, cell, saves, residual
) -> tuple:
    gates, (n_steps, n_lanes, width) = product(x, input_weight, bias), x.shape
    outputs, hiddens = torch.empty_like(x), torch.empty_like(x)
    last_output, last_cell, saved = torch.empty_like(output), torch.empty_like(cell), [None, None]
    if saves:
        n_clusters = -(-n_lanes // _LANES)
        lead = n_steps, n_clusters, width // _BLOCK_UNITS, _LANES // 8, _THREADS
        saved = [gates.new_empty(*lead, 8), cell.new_empty(*lead, 2)]
    work = side_stream.take_work()
    with side_stream.fork(None if work is None else side_stream.fork_point(x.device)) as stream:
        with torch.cuda.stream(stream):
            _launch_clusters(
                *("forward", width, x.device, n_lanes),
                **dict(gates=gates, weight=weight, reset=reset, residual=residual),
                **dict(last_output=output, last_cell=cell, output=last_output, cell=last_cell),
                **dict(outputs=outputs, hiddens=hiddens),
                **dict(saved_gates=saved[0], saved_cells=saved[1], n_steps=n_steps),
            )
        if work is not None:
            work()
        if saves:  # also memory for gradients: what is freed later may still be read by a stream
            d_states = (torch.empty_like(cell) for _ in range(2))
            d_bias = cell.new_empty(n_clusters, 4 * width)
            saved = [*saved, weight.T.contiguous(), gates, d_bias, *d_states]
    return outputs, hiddens, last_output, last_cell, saved


def _backward_on_clusters(input_weight, weight, reset, saved, d_outputs, d_cell) -> tuple:
    n_steps, n_lanes, width = d_outputs.shape
    d_gates, d_bias, d_last_output, d_last_cell = saved[3:]
    _launch_clusters(
        *("backward", width, weight.device, n_lanes),
        **dict(weight=saved[2], reset=reset),
        **dict(saved_gates=saved[0], saved_cells=saved[1], d_outputs=d_outputs, d_cell=d_cell),
        **dict(d_gates=d_gates, d_bias=d_bias),
        **dict(d_last_output=d_last_output, d_last_cell=d_last_cell),
        n_steps=n_steps,
    )
    return d_gates, d_bias, d_last_output, d_last_cell, None


# ---- On a CPU ----


def _forward_on_cpu(x, input_weight, bias, weight, reset, output, cell, saves, residual) -> tuple:
    n_steps, n_lanes, width = x.shape
    gates, last_cell = x.new_empty(n_steps, n_lanes, 4 * width), torch.empty_like(cell)
    hiddens, cells, outputs = (torch.empty_like(x) for _ in range(3))
    launch(
        *(LIBRARY, "lstm_sequence_forward", x.device, 0),
        **dict(x=x, input_weight=input_weight, bias=bias, weight=weight, reset=reset),
        **dict(first_output=output, first_cell=cell, gates=gates, hiddens=hiddens, cells=cells),
        **dict(outputs=outputs, last_cell=last_cell),
        **dict(n_steps=n_steps, n_lanes=n_lanes, width=width, n_threads=threads()),
    )
    summed = outputs if residual is None else outputs + residual
    return summed, hiddens, outputs[-1].clone(), last_cell, (gates, cells)


def _backward_on_cpu(input_weight, weight, reset, saved, d_outputs, d_cell) -> tuple:
    (gates, cells), (n_steps, n_lanes, width) = saved, d_outputs.shape
    d_gates, d_x, d_last = torch.empty_like(gates), torch.empty_like(d_outputs), cells[0]
    d_cell = torch.zeros_like(d_last) if d_cell is None else d_cell
    d_first_output, d_first_cell = torch.empty_like(d_last), torch.empty_like(d_last)
    launch(
        *(LIBRARY, "lstm_sequence_backward", d_outputs.device, 0),
        **dict(input_weight=input_weight, weight=weight, reset=reset, gates=gates, cells=cells),
        **dict(d_outputs=d_outputs, d_last_cell=d_cell, d_gates=d_gates, d_x=d_x),
        **dict(d_output=d_first_output, d_cell=d_first_cell),
        **dict(n_steps=n_steps, n_lanes=n_lanes, width=width, n_threads=threads()),
    )
    return d_gates, d_gates.flatten(0, 1), d_first_output, d_first_cell, d_x


# ---- The recurrence with an explicit gradient ----


class _Sequence(torch.autograd.Function):
    """Autograd would accumulate the weights' gradients step by step. Here each is one product. A
    CPU's kernels are float32, those of clusters bfloat16.
    """

    @staticmethod
    def forward(
        ctx, has_grad, x, input_weight, bias, weight, reset, output, cell, is_residual
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        ctx.set_materialize_grads(False)
        ctx.on_cpu, ctx.is_residual = x.dtype == torch.float32, is_residual
        # checkpoints and the like write what backward reads only when a gradient is there
        hooks = torch._C._autograd._top_saved_tensors_default_hooks(False)  # pyright: ignore[reportAttributeAccessIssue]
        ctx.may_fork = hooks is None and torch._C._current_graph_task_id() < 0
        x, reset, output, cell = aligned(x), reset.contiguous(), aligned(output), aligned(cell)
        input_weight, bias, weight = (
            cast(w, x.dtype).contiguous() for w in (input_weight, bias, weight)
        )
        saves = has_grad and any(ctx.needs_input_grad)
        states, residual = (output, cell), x if is_residual else None
        forward = _forward_on_cpu if ctx.on_cpu else _forward_on_clusters
        outputs, hiddens, last_output, last_cell, saved = forward(
            x, input_weight, bias, weight, reset, *states, saves, residual
        )
        ctx.save_for_backward(x, input_weight, weight, reset, hiddens, *saved)
        return outputs, last_output, last_cell

    @staticmethod
    @once_differentiable
    def backward(ctx, d_outputs, d_last_output, d_cell) -> tuple[torch.Tensor | None, ...]:
        x, input_weight, weight, reset, hiddens, *saved = ctx.saved_tensors
        d_sum = d_outputs = torch.zeros_like(x) if d_outputs is None else aligned(d_outputs)
        if d_last_output is not None:
            d_outputs = d_sum.clone()
            d_outputs[-1] += d_last_output
        d_cell = None if d_cell is None else aligned(d_cell)
        backward = _backward_on_cpu if ctx.on_cpu else _backward_on_clusters
        residual = d_sum if ctx.is_residual else None
        if residual is not None and not ctx.on_cpu:
            residual = residual.clone()
        event = side_stream.ready_event(d_outputs) if d_cell is None and ctx.may_fork else None
        ctx.may_fork = False  # of a retained graph, the memory for gradients may still be read
        with side_stream.fork(event) as stream, torch.cuda.stream(stream):
            d_gates, d_bias, d_output, d_cell, d_x = backward(
                input_weight, weight, reset, saved, d_outputs, d_cell
            )
        if d_x is None:
            d_x = gradient_of_inputs(d_gates, input_weight, residual)
        elif residual is not None:
            d_x += residual
        side_stream.mark_ready(d_x)  # first what the sequence of the layer below waits for
        d_bias = d_bias.sum(0) if ctx.on_cpu else sum_rows(d_bias)
        flat, by_kernel = d_gates.flatten(0, 1), (lambda d, rows: matmul(d.T, rows))
        of_weights = by_kernel if ctx.on_cpu else gradient_of_weights
        d_input, d_weight = (of_weights(flat, rows.flatten(0, 1)) for rows in (x, hiddens))
        d_states = zip((d_output, d_cell), ctx.needs_input_grad[6:])
        d_output, d_cell = (d.clone() if is_needed else None for d, is_needed in d_states)
        return None, d_x, d_input, d_bias.float(), d_weight, None, d_output, d_cell, None


@fused(lambda *inputs: _Sequence.apply(torch.is_grad_enabled(), *inputs), _fits, on_cpu=True)
def lstm_sequence(
    x: torch.Tensor,
    input_weight: torch.Tensor,
    bias: torch.Tensor,
    weight: torch.Tensor,
    reset: torch.Tensor,
    output: torch.Tensor,
    cell: torch.Tensor,
    is_residual: bool,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Unrolls the recurrence. Nothing is done in place, as exporters want it.

    Args:
        x: (T, B, W) in the compute dtype; added to the outputs if `is_residual`.
        input_weight, bias: (4 W, W), (4 W,).
        weight: (4 W, W), of the recurrent product.
        reset: (T, B) bool.
        output, cell: (B, W) float32, before the sequence.

    Returns:
        outputs (T, B, W) in the compute dtype, the last output without x and the last cell, (B, W)
        float32.
    """
    outputs = []
    for t in range(len(x)):
        output, cell = (leaf.masked_fill(reset[t, :, None], 0.0) for leaf in (output, cell))
        gates = F.linear(x[t], input_weight, bias) + F.linear(output.to(x.dtype), weight)
        i, f, g, o = gates.float().chunk(4, -1)
        cell = f.sigmoid() * cell + i.sigmoid() * g.tanh()
        output = (o.sigmoid() * cell.tanh()).to(x.dtype)
        outputs.append(output + x[t] if is_residual else output)
    return torch.stack(outputs), output.float(), cell


def _act_on_gpu(core, x, reset, state, is_residual=False) -> tuple[torch.Tensor, arrdict]:
    """Computes one step in one kernel. The next state's output is bfloat16, which loses nothing."""
    check_shapes(x, reset, state)
    x, reset = x.to(torch.bfloat16), reset.bool()
    weight = cast_joined((core.input.weight, core.recurrent.weight), x.dtype)
    bias = cast(core.input.bias, x.dtype)
    outputs, cell, output = step.step(
        *(step.LSTM, x, weight, bias, reset, state["cell"].float(), is_residual, state["output"])
    )
    return outputs, arrdict(output=output, cell=cell)


def _acts_on_gpu(core, x, *_, **__) -> bool:
    dtype = compute_dtype(core.recurrent.weight)
    return not torch.is_grad_enabled() and step.fits(step.LSTM, x, dtype)


class LSTM(nn.Module):
    """An LSTM of `width` units. Its hidden state is arrdict(output, cell), each (B, W) float32, but
    the output bfloat16 after a step by a kernel: the same numbers.
    """

    adds_input = True

    def __init__(self, width: int):
        super().__init__()
        self.width = width
        self.input = nn.Linear(width, 4 * width)
        self.recurrent = nn.Linear(width, 4 * width, bias=False)
        with torch.no_grad():
            for block in (*self.input.weight.split(width), *self.recurrent.weight.split(width)):
                nn.init.orthogonal_(block)
            # Forget gates start open, so that gradients reach far back from the beginning
            # (Jozefowicz et al. 2015)
            self.input.bias.zero_()[width : 2 * width] = 1.0

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the hidden state of B lanes at the start of an episode."""
        return arrdict(
            {key: torch.zeros(n_lanes, self.width, device=device) for key in ("output", "cell")}
        )

    @fused(_act_on_gpu, _acts_on_gpu)
    def forward(
        self, x: torch.Tensor, reset: torch.Tensor, state: arrdict, is_residual: bool = False
    ) -> tuple[torch.Tensor, arrdict]:
        """Unrolls over a sequence, as the head of cores.py says. Outputs are in the
        compute dtype on a GPU and float32 on a CPU. ValueError if shapes or devices do not fit.
        """
        check_shapes(x, reset, state)
        x = x.to(compute_dtype(self.recurrent.weight) if x.is_cuda else torch.float32)
        weights = self.input.weight, self.input.bias, self.recurrent.weight
        states = state["output"].float(), state["cell"].float()
        outputs, output, cell = lstm_sequence(x, *weights, reset.bool(), *states, is_residual)
        return outputs, arrdict(output=output, cell=cell)
