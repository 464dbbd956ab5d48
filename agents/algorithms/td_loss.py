"""R2D2's loss: the error of action values from n-step returns of a target network (Kapturowski et
al. 2019, section 2.3), with the priorities that follow from it.

T steps after the burn-in, M sequences, A agents per lane, n choices.
"""

from typing import NamedTuple

import torch
from torch.autograd.function import once_differentiable

from megastep.agents.algorithms import returns
from megastep.agents.algorithms.kernels import LIBRARY
from megastep.agents.algorithms.masked_stats import effective_sample_size, masked_mean
from megastep.agents.networks.fused import fused
from megastep.agents.networks.outputs import Output
from megastep.agents.storage.rollout import without_last
from megastep.arrdict import arrdict
from megastep.coefficients import on_device
from megastep.kernels.build.launch import Blocks, launch
from megastep.types import Tree

_METRICS = "td", "td_error", "q", "staleness", "effective_samples"
_ENDS = "reward", "terminal", "truncated"
_EPS = 1e-3  # of `returns.rescale`
_THREADS = LIBRARY.constants["TD_THREADS"]
_SEQUENCES = LIBRARY.constants["TD_SEQUENCES"]
_N_SUMS, _N_METRICS = (LIBRARY.constants[f"N_TD_{name}"] for name in ("SUMS", "METRICS"))


class Settings(NamedTuple):
    """The settings of the loss; see `R2D2`."""

    gamma: float | torch.Tensor
    return_steps: int
    eta: float


class Result(NamedTuple):
    """What a minibatch gives.

    Attributes:
        loss: (), the mean of the weighted squared errors over the valid steps.
        metrics: tensors () by name.
        priorities: (M,).
        n_valid: (), the number of valid steps.
    """

    loss: torch.Tensor
    metrics: dict[str, torch.Tensor]
    priorities: torch.Tensor
    n_valid: torch.Tensor


class _Loss(torch.autograd.Function):
    """`td_loss` in two kernels. The gradient of the sum over valid steps is left for the
    backward pass.
    """

    @staticmethod
    def forward(
        ctx, q, target_q, batch, settings
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        n_rows, n_sequences, n_agents, n_choices = q.shape
        n_blocks = -(-n_sequences // _SEQUENCES)
        d_q = torch.empty_like(q, memory_format=torch.contiguous_format)
        values = q.new_empty(n_rows, n_sequences)
        priorities = q.new_empty(n_sequences)
        sums, metrics = q.new_empty(n_blocks, _N_SUMS), q.new_empty(_N_METRICS)
        names = *_ENDS, "actions", "starts", "learns", "weight", "age"
        tensors = {name: batch[name].contiguous() for name in names}
        launch(
            *(LIBRARY, "td_loss", q.device, Blocks(n_blocks, threads=_THREADS)),
            **dict(q=q.contiguous(), target_q=target_q.contiguous(), **tensors),
            **dict(values=values, d_q=d_q, priorities=priorities, sums=sums),
            **dict(n_steps=n_rows - 1, n_sequences=n_sequences),
            **dict(n_agents=n_agents, n_choices=n_choices),
            **dict(gamma=on_device(settings.gamma, q.device), eta=settings.eta, eps=_EPS),
            n_return_steps=settings.return_steps,
        )
        launch(
            *(LIBRARY, "td_metrics", q.device, Blocks(1, threads=_THREADS)),
            **dict(sums=sums, metrics=metrics, n_blocks=n_blocks, n_sequences=n_sequences),
        )
        ctx.save_for_backward(d_q, metrics)
        ctx.mark_non_differentiable(metrics, priorities)
        return metrics[0].clone(), metrics, priorities

    @staticmethod
    @once_differentiable
    def backward(ctx, d_loss, d_metrics, d_priorities) -> tuple[torch.Tensor | None, ...]:
        d_q, metrics = ctx.saved_tensors
        return d_q * (d_loss * metrics[-1]), None, None, None


def _loss_on_gpu(q, target_q, batch, output, settings) -> Result:
    loss, metrics, priorities = _Loss.apply(q, target_q, batch, settings)
    *values, n_valid, _ = metrics.unbind()
    return Result(loss, dict(zip(_METRICS, values, strict=True)), priorities, n_valid)


@fused(
    _loss_on_gpu,
    lambda q, *_: isinstance(q, torch.Tensor) and q.is_cuda and q.dtype == torch.float32,
)
def td_loss(q: Tree, target_q: Tree, batch: arrdict, output: Output, settings: Settings) -> Result:
    """Computes loss, metrics and priorities.

    Args:
        q: (T+1, M, A, n) of the online network, or a tree of these.
        target_q: those of the target network, without a gradient.
        batch: has `actions`, `reward`, `terminal` and `truncated`, (T, M, ...) each, `starts` and
            `learns` (T+1, M), `weight` and `age` (M,).
        output: the policy's output.
        settings: the settings.
    """
    reset = batch.starts[1:]
    valid = ~reset & batch.learns[:-1]
    with torch.no_grad():
        value = returns.inverse_rescale(output.action_value(target_q, output.greedy(q)), _EPS)
        targets = returns.n_step_returns(
            **{name: batch[name] for name in _ENDS},
            value=value[:-1],
            last_value=value[-1],
            reset=reset,
            gamma=settings.gamma,
            n=settings.return_steps,
        )
    q_taken = output.action_value(without_last(q), batch.actions)
    error = (returns.rescale(targets, _EPS) - q_taken).masked_fill(~valid, 0.0)
    loss = masked_mean(batch.weight * error.square(), valid)
    with torch.no_grad():
        size, eta = error.abs(), settings.eta
        priorities = eta * size.amax(0) + (1 - eta) * masked_mean(size, valid, 0)
        all_sequences = torch.ones_like(batch.weight, dtype=torch.bool)
        metrics = dict(
            td=loss,
            td_error=masked_mean(size, valid),
            q=masked_mean(returns.inverse_rescale(q_taken, _EPS), valid),
            staleness=batch.age.float().mean(),
            effective_samples=effective_sample_size(batch.weight, all_sequences),
        )
    return Result(loss, metrics, priorities, valid.sum())
