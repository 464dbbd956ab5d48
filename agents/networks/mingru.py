"""A minimal gated recurrent unit (minGRU, Feng et al. 2024, "Were RNNs all we needed?") whose
hidden state is cleared inside a sequence where an episode starts.

    z_t = sigmoid(W_z x_t + b_z)             update gate
    c_t = W_c x_t + b_c                      candidate
    h_t = (1 - z_t) h_{t-1} + z_t c_t        h_{t-1} = 0 at a reset

Gate and candidate depend on the input alone, not on h. So a sequence takes one matrix product for
all its steps and then a linear recurrence, computed by a scan, whose gradient is a scan in reverse.
This is the paper's plain form. The paper's log-space form needs candidates that are never negative,
and a reset, a factor of 0, has no logarithm.

T time, B lanes, W width. Gates are laid out (..., 2 W): update gate before its sigmoid, candidate.
Matrix products run in the compute dtype (autocast's). The recurrence is float32: over hundreds of
steps a bfloat16 state would round small additions away.

The recurrence over a sequence is written here for the CPU, with its gradient; a GPU has a kernel
for each. When acting, one kernel does product and recurrence (`mingru_step`). `mingru` is the plain
form of all of it.
"""

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from megastep.agents.networks import mingru_step
from megastep.agents.networks.fused import (
    DTYPES,
    LIBRARY,
    aligned,
    check_shapes,
    fused,
    launch_units,
)
from megastep.agents.networks.linear import gradient_of_weights, product, sum_rows
from megastep.agents.networks.precision import cast, compute_dtype
from megastep.arrdict import arrdict
from megastep.kernels.build.launch import BLOCK, Blocks, launch

_LARGEST_BLOCK = 256  # threads, of the backward kernel
_MANY_BLOCKS = 128  # about one per multiprocessor


def linear_scan(
    terms: torch.Tensor,
    factors: torch.Tensor,
    reset: torch.Tensor | None = None,
    reverse: bool = False,
) -> torch.Tensor:
    """Computes y_t = terms_t + factors_t y_{t-1}, y_{-1} = 0, along the first axis.

    Uses parallel doubling (Hillis and Steele 1986): after a pass of stride k, `total` holds the
    last 2k terms of each sum, `product` the factor of what comes before them, and `reset` whether
    that factor is cut off. Nothing is divided by a product, so factors of 0 are exact.

    Args:
        terms: (T, ...).
        factors: (T, ...).
        reset: bool, of a shape that broadcasts to theirs. Where true, y_t = terms_t, and nothing
            passes, not even a NaN.
        reverse: runs from the end instead, y_t = terms_t + factors_t y_{t+1}, y_T = 0.
    """
    if reverse:
        reset = None if reset is None else reset.flip(0)
        return linear_scan(terms.flip(0), factors.flip(0), reset).flip(0)
    total, product, stride = terms, factors, 1
    while stride < len(terms):
        first, here, before = slice(stride), slice(stride, None), slice(-stride)
        sums = torch.addcmul(total[here], product[here], total[before])
        if reset is not None:
            sums = torch.where(reset[here], total[here], sums)
            reset = torch.cat([reset[first], reset[here] | reset[before]])
        total = torch.cat([total[first], sums])
        product = torch.cat([product[first], product[here] * product[before]])
        stride *= 2
    return total


def _split(gates) -> tuple[torch.Tensor, torch.Tensor]:
    update, candidate = gates.float().chunk(2, -1)
    return update.sigmoid(), candidate


def _forward_on_gpu(gates, reset, start, residual, states, outputs, last) -> None:
    launch_units(
        *("mingru_step" if len(gates) == 1 else "mingru_forward", gates.dtype, start),
        **dict(gates=gates, reset=reset, start=start, residual=residual),
        **dict(states=states, outputs=outputs, last=last, n_steps=len(gates)),
    )


@fused(_forward_on_gpu, lambda gates, *_: gates.is_cuda)
def recurrence(gates, reset, start, residual, states, outputs, last) -> None:
    """Computes the last three from the gates and the first state.

    Args:
        gates: (T, B, 2 W).
        reset: (T, B) bool.
        start: (B, W) float32.
        residual: (T, B, W), added to the outputs. None: nothing is.
        states: (T, B, W), the outputs without the residual. None: not wanted.
        outputs: (T, B, W).
        last: (B, W) float32.
    """
    (z, candidate), reset = _split(gates), reset[..., None]
    terms, factors = z * candidate, 1 - z
    terms[0].addcmul_(factors[0], start.masked_fill(reset[0], 0.0))
    exact = linear_scan(terms, factors, reset)
    outputs.copy_(exact if residual is None else exact + residual)
    last.copy_(exact[-1])
    if states is not None:
        states.copy_(exact)


def _backward_on_gpu(
    gates, reset, start, states, d_outputs, d_last, d_gates, d_start, d_residual
) -> torch.Tensor:
    n_lanes, width = start.shape
    n_units = 1 if width % 4 else 4
    per_lane = width // n_units  # threads
    per_block = max(1, min(_LARGEST_BLOCK // per_lane, n_lanes // _MANY_BLOCKS))  # lanes
    adds_lanes = per_lane <= _LARGEST_BLOCK
    block = per_block * per_lane if adds_lanes else BLOCK
    d_biases = start.new_empty(-(-n_lanes // per_block), gates.shape[-1])
    blocks = Blocks(-(-n_lanes * per_lane // block), threads=block, shared=4 * n_units * block)
    launch(
        *(LIBRARY, f"mingru_backward_{DTYPES[gates.dtype]}", start.device, blocks),
        **dict(gates=gates, reset=reset, start=start, states=states),
        **dict(d_outputs=d_outputs, d_last=d_last, d_gates=d_gates, d_start=d_start),
        **dict(d_residual=d_residual, d_biases=d_biases),
        **dict(n_steps=len(gates), n_lanes=n_lanes, width=width, n_units=n_units),
        adds_lanes=int(adds_lanes),
    )
    return sum_rows(d_biases)


@fused(_backward_on_gpu, lambda gates, *_: gates.is_cuda)
def recurrence_backward(
    gates, reset, start, states, d_outputs, d_last, d_gates, d_start, d_residual
) -> torch.Tensor:
    """Computes the gradients of `recurrence`'s gates and first state from those of its outputs.

    Args:
        d_last: None: zeros.
        d_start: None: not wanted.
        d_residual: (T, B, W), a copy of `d_outputs`. None: not wanted.

    Returns:
        the gates' gradient summed over steps and lanes, (2 W,) float32.
    """
    (z, candidate), reset = _split(gates), reset[..., None]
    factors, before = 1 - z, torch.cat([start[None], states[:-1]]).masked_fill(reset, 0.0)
    terms = d_outputs
    if d_last is not None:
        terms = torch.cat([d_outputs[:-1], (d_outputs[-1] + d_last)[None]])
    # Row t needs the factor and reset of step t + 1. The last row is not used.
    d = linear_scan(terms, factors.roll(-1, 0), reset.roll(-1, 0), reverse=True)
    d_update, d_candidate = d_gates.chunk(2, -1)
    d_update.copy_(d * (candidate - before) * z * factors)
    d_candidate.copy_(d * z)
    if d_start is not None:
        d_start.copy_((d[0] * factors[0]).masked_fill(reset[0], 0.0))
    if d_residual is not None:
        d_residual.copy_(d_outputs)
    return d_gates.flatten(0, 1).sum(0).float()


class _Sequence(torch.autograd.Function):
    """The product of all steps and the recurrence over time, with an explicit gradient.

    Saves only its input, the gates and the states. If they are bfloat16, the gradient sees states
    rounded to bfloat16.
    """

    @staticmethod
    def forward(
        ctx, x, weight, bias, reset, start, is_residual, has_grad
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Unrolls the recurrence.

        Args:
            x: (T, B, W) in the compute dtype.
            weight: (2 W, W).
            bias: (2 W,).
            reset: (T, B) bool.
            start: (B, W) float32, state before the sequence.
            is_residual: adds x to the outputs.
            has_grad: whether autograd is on; it never is in here.

        Returns:
            outputs (T, B, W) in the compute dtype, and the last state (B, W) float32.
        """
        ctx.set_materialize_grads(False)
        ctx.is_residual = is_residual
        x, reset, start = aligned(x), reset.contiguous(), aligned(start)
        weight, bias = cast(weight, x.dtype), cast(bias, x.dtype)
        needs_backward = has_grad and any(ctx.needs_input_grad)
        if not needs_backward and mingru_step.fits(x):
            return mingru_step.forward(x, weight, bias, reset, start, is_residual)
        gates = product(x, weight, bias)
        outputs, last = torch.empty_like(x), torch.empty_like(start)
        states = torch.empty_like(x) if is_residual and needs_backward else None
        residual = x if is_residual else None
        recurrence(gates, reset, start, residual, states, outputs, last)
        states = outputs if states is None else states
        ctx.save_for_backward(x, weight, gates, reset, start, states)
        return outputs, last

    @staticmethod
    @once_differentiable
    def backward(ctx, d_outputs, d_last) -> tuple[torch.Tensor | None, ...]:
        x, weight, gates, reset, start, states = ctx.saved_tensors
        d_outputs = torch.zeros_like(x) if d_outputs is None else aligned(d_outputs)
        d_last = None if d_last is None else aligned(d_last)
        d_gates = torch.empty_like(gates)
        d_start = torch.empty_like(start) if ctx.needs_input_grad[4] else None
        # torch.addmm would copy d_outputs, and a gradient must not change in place
        d_residual = torch.empty_like(x) if ctx.is_residual else None
        d_bias = recurrence_backward(
            *(gates, reset, start, states, d_outputs, d_last), *(d_gates, d_start, d_residual)
        )
        flat = d_gates.flatten(0, 1)
        if d_residual is None:
            d_x = (flat @ weight).view_as(x)
        elif x.is_cuda:
            d_residual.view(flat.shape[0], -1).addmm_(flat, weight)
            d_x = d_residual
        else:  # in one operation, a CPU would add up the product's sums in another order
            d_x = d_residual.add_((flat @ weight).view_as(x))
        return d_x, gradient_of_weights(flat, x.flatten(0, 1)), d_bias, None, d_start, None, None


def _sequence(core, x, reset, state, is_residual) -> tuple[torch.Tensor, arrdict]:
    x, start = x.to(compute_dtype(core.input.weight)), state["output"].float()
    sequence = x, core.input.weight, core.input.bias, reset.bool(), start, is_residual
    # autocast would choose its own dtypes inside
    with torch.autocast(x.device.type, enabled=False):
        outputs, last = _Sequence.apply(*sequence, torch.is_grad_enabled())
    return outputs, arrdict(output=last)


@fused(_sequence, lambda core, *_: compute_dtype(core.input.weight) in DTYPES)
def mingru(core, x, reset, state, is_residual) -> tuple[torch.Tensor, arrdict]:
    """Does `MinGRU.forward` step by step. Nothing is done in place, as exporters want it."""
    output, outputs = state["output"], []
    for t in range(len(x)):
        z, candidate = _split(core.input(x[t]))
        output = (1 - z) * output.masked_fill(reset[t, :, None], 0.0) + z * candidate
        outputs.append(output.to(x.dtype) + x[t] if is_residual else output.to(x.dtype))
    return torch.stack(outputs), arrdict(output=output)


class MinGRU(nn.Module):
    """A minGRU of `width` units. Its hidden state is arrdict(output (B, W)) float32."""

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

    def forward(
        self, x: torch.Tensor, reset: torch.Tensor, state: arrdict, is_residual: bool = False
    ) -> tuple[torch.Tensor, arrdict]:
        """Unrolls over a sequence, as the head of cores.py says. Outputs are in the
        compute dtype. ValueError if shapes or devices do not fit.
        """
        check_shapes(x, reset, state)
        return mingru(self, x, reset, state, is_residual)
