"""A minimal gated recurrent unit (minGRU, Feng et al. 2024, "Were RNNs all we needed?") whose
hidden state is cleared inside a sequence where an episode starts.

    z_t = sigmoid(W_z x_t + b_z)             update gate
    c_t = W_c x_t + b_c                      candidate
    h_t = (1 - z_t) h_{t-1} + z_t c_t        h_{t-1} = 0 at a reset

Gate and candidate depend on the input alone, not on h. So a sequence takes one matrix product for
all its steps and then a linear recurrence, computed by a scan, whose gradient is a scan in reverse.
The paper's log-space form needs positive candidates, and a reset, a factor of 0, has no logarithm.

T time, B lanes, W width. Gates are laid out (..., 2 W): update gate before its sigmoid, candidate.
Matrix products run in the compute dtype (autocast's). The recurrence is float32: over hundreds of
steps a bfloat16 state would round small additions away.

A GPU has a kernel for the recurrence over a sequence, and one for its gradient. When acting, one
kernel does product and recurrence (`step.py`).
"""

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from megastep.agents.networks import step
from megastep.agents.networks.fused import DTYPES, LIBRARY, aligned, check_shapes, fused
from megastep.agents.networks.linear import (
    cast,
    compute_dtype,
    gradient_of_weights,
    linear_scan,
    product,
    sum_rows,
)
from megastep.arrdict import arrdict
from megastep.kernels.build.launch import BLOCK, Blocks, launch

_LARGEST_BLOCK = 256  # threads, of the backward kernel
_MANY_BLOCKS = 128  # about one per multiprocessor


def _split(gates) -> tuple[torch.Tensor, torch.Tensor]:
    update, candidate = gates.float().chunk(2, -1)
    return update.sigmoid(), candidate


def _forward_on_gpu(gates, reset, start, residual=None, has_states=False) -> tuple:
    n_lanes, width = start.shape
    n_units = 1 if width % 4 else 4  # neighbours of a lane, that a thread has
    outputs, last = gates.new_empty(*reset.shape, width), torch.empty_like(start)
    states = torch.empty_like(outputs) if has_states else None
    operation, n_threads = f"mingru_forward_{DTYPES[gates.dtype]}", start.numel() // n_units
    launch(
        *(LIBRARY, operation, start.device, n_threads),
        **dict(gates=gates, reset=reset, start=start, residual=residual),
        **dict(states=states, outputs=outputs, last=last, n_steps=len(gates)),
        **dict(n_lanes=n_lanes, width=width, n_units=n_units),
    )
    return outputs, last, states


@fused(_forward_on_gpu, lambda gates, *_, **__: gates.is_cuda)
def recurrence(
    gates: torch.Tensor,
    reset: torch.Tensor,
    start: torch.Tensor,
    residual: torch.Tensor | None = None,
    has_states: bool = False,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None]:
    """Returns from gates (T, B, 2 W), resets (T, B) bool and the first state (B, W) float32 the
    outputs (T, B, W), to which a residual (T, B, W) is added; the last state (B, W) float32; and,
    if `has_states`, the outputs without the residual.
    """
    (z, candidate), reset = _split(gates), reset[..., None]
    terms, factors = z * candidate, 1 - z
    terms[0].addcmul_(factors[0], start.masked_fill(reset[0], 0.0))
    exact = linear_scan(terms, factors, reset)
    outputs = (exact if residual is None else exact + residual).to(gates.dtype)
    return outputs, exact[-1].clone(), exact.to(gates.dtype) if has_states else None


def _backward_on_gpu(gates, reset, start, states, d_outputs, d_last, has_residual) -> tuple:
    n_lanes, width = start.shape
    n_units = 1 if width % 4 else 4
    per_lane = width // n_units  # threads
    per_block = max(1, min(_LARGEST_BLOCK // per_lane, n_lanes // _MANY_BLOCKS))  # lanes
    adds_lanes = per_lane <= _LARGEST_BLOCK
    block = per_block * per_lane if adds_lanes else BLOCK
    d_biases = start.new_empty(-(-n_lanes // per_block), gates.shape[-1])
    d_gates, d_start = torch.empty_like(gates), torch.empty_like(start)
    d_residual = torch.empty_like(d_outputs) if has_residual else None
    blocks = Blocks(-(-n_lanes * per_lane // block), threads=block, shared=4 * n_units * block)
    launch(
        *(LIBRARY, f"mingru_backward_{DTYPES[gates.dtype]}", start.device, blocks),
        **dict(gates=gates, reset=reset, start=start, states=states),
        **dict(d_outputs=d_outputs, d_last=d_last, d_gates=d_gates, d_start=d_start),
        **dict(d_residual=d_residual, d_biases=d_biases),
        **dict(n_steps=len(gates), n_lanes=n_lanes, width=width, n_units=n_units),
        adds_lanes=int(adds_lanes),
    )
    return d_gates, sum_rows(d_biases), d_start, d_residual


@fused(_backward_on_gpu, lambda gates, *_: gates.is_cuda)
def recurrence_backward(
    gates: torch.Tensor,
    reset: torch.Tensor,
    start: torch.Tensor,
    states: torch.Tensor,
    d_outputs: torch.Tensor,
    d_last: torch.Tensor | None,
    has_residual: bool,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor | None]:
    """Returns the gradients of the gates, of these summed over steps and lanes, (2 W,) float32, of
    the first state, and of the residual, a new tensor; from those of `recurrence`'s outputs and
    last state.
    """
    (z, candidate), reset = _split(gates), reset[..., None]
    factors, before = 1 - z, torch.cat([start[None], states[:-1]]).masked_fill(reset, 0.0)
    terms = d_outputs
    if d_last is not None:
        terms = torch.cat([d_outputs[:-1], (d_outputs[-1] + d_last)[None]])
    # Row t needs the factor and reset of step t + 1. The last row is not used.
    d = linear_scan(terms, factors.roll(-1, 0), reset.roll(-1, 0), reverse=True)
    d_update = d * (candidate - before) * z * factors
    d_gates = torch.cat([d_update, d * z], -1).to(gates.dtype)
    d_start = (d[0] * factors[0]).masked_fill(reset[0], 0.0)
    d_bias = d_gates.flatten(0, 1).sum(0).float()
    return d_gates, d_bias, d_start, d_outputs.clone() if has_residual else None


# ---- Product and recurrence ----


class _Sequence(torch.autograd.Function):
    """Saves only its input, the gates and the states. If they are bfloat16, the gradient sees
    states rounded to bfloat16.
    """

    @staticmethod
    def forward(
        ctx, x, weight, bias, reset, start, is_residual, has_grad
    ) -> tuple[torch.Tensor, torch.Tensor]:
        ctx.set_materialize_grads(False)
        ctx.is_residual = is_residual
        x, reset, start = aligned(x), reset.contiguous(), aligned(start)
        weight, bias = cast(weight, x.dtype), cast(bias, x.dtype)
        needs_backward = has_grad and any(ctx.needs_input_grad)
        if not needs_backward and step.fits(step.MINGRU, x, x.dtype):
            return step.step(step.MINGRU, x, weight, bias, reset, start, is_residual)[:2]
        gates, residual = product(x, weight, bias), x if is_residual else None
        has_states = is_residual and needs_backward
        outputs, last, states = recurrence(gates, reset, start, residual, has_states)
        states = outputs if states is None else states
        ctx.save_for_backward(x, weight, gates, reset, start, states)
        return outputs, last

    @staticmethod
    @once_differentiable
    def backward(ctx, d_outputs, d_last) -> tuple[torch.Tensor | None, ...]:
        x, weight, *saved = ctx.saved_tensors
        d_outputs = torch.zeros_like(x) if d_outputs is None else aligned(d_outputs)
        d_last = None if d_last is None else aligned(d_last)
        d_gates, d_bias, d_start, d_x = recurrence_backward(
            *saved, d_outputs, d_last, ctx.is_residual
        )
        flat = d_gates.flatten(0, 1)
        if d_x is not None and x.is_cuda:  # torch.addmm would copy d_outputs once more
            d_x.view(len(flat), -1).addmm_(flat, weight)
        else:
            product_of_gates = (flat @ weight).view_as(x)
            # in one operation, a CPU would add up the product's sums in another order
            d_x = product_of_gates if d_x is None else d_x.add_(product_of_gates)
        return d_x, gradient_of_weights(flat, x.flatten(0, 1)), d_bias, None, d_start, None, None


def _sequence(core, x, reset, state, is_residual=False) -> tuple[torch.Tensor, arrdict]:
    check_shapes(x, reset, state)
    x, start = x.to(compute_dtype(core.input.weight)), state["output"].float()
    sequence = x, core.input.weight, core.input.bias, reset.bool(), start, is_residual
    # autocast would choose its own dtypes inside
    with torch.autocast(x.device.type, enabled=False):
        outputs, last = _Sequence.apply(*sequence, torch.is_grad_enabled())
    return outputs, arrdict(output=last)


class MinGRU(nn.Module):
    """A minGRU of `width` units. Its hidden state is arrdict(output (B, W)) float32."""

    adds_input = True

    def __init__(self, width: int):
        super().__init__()
        self.width = width
        self.input = nn.Linear(width, 2 * width)
        for block in self.input.weight.split(width):
            nn.init.orthogonal_(block)
        # Units start with time constants from 1 to 32 steps (chrono initialisation, Tallec and
        # Ollivier 2018). With 1 step for all, a cue needed 12 steps later is learned late.
        nn.init.zeros_(self.input.bias)
        with torch.no_grad():
            self.input.bias[:width] = -torch.linspace(1, 32, width).log()

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the hidden state of B lanes at the start of an episode."""
        return arrdict(output=torch.zeros(n_lanes, self.width, device=device))

    @fused(_sequence, lambda core, *_, **__: compute_dtype(core.input.weight) in DTYPES, True)
    def forward(
        self, x: torch.Tensor, reset: torch.Tensor, state: arrdict, is_residual: bool = False
    ) -> tuple[torch.Tensor, arrdict]:
        """Unrolls over a sequence, as the head of cores.py says. Outputs are in the
        compute dtype. ValueError if shapes or devices do not fit.
        """
        check_shapes(x, reset, state)
        output, outputs = state["output"], []
        for t in range(len(x)):  # nothing is done in place, as exporters want it
            z, candidate = _split(self.input(x[t]))
            output = (1 - z) * output.masked_fill(reset[t, :, None], 0.0) + z * candidate
            outputs.append(output.to(x.dtype) + x[t] if is_residual else output.to(x.dtype))
        return torch.stack(outputs), arrdict(output=output)
