"""The gradient steps of an update. Non-finite steps are skipped and counted."""

import functools
from collections.abc import Iterable

import torch
from torch.autograd.graph import _engine_run_backward as run_backward

from megastep.agents.algorithms.kernels import LIBRARY
from megastep.agents.algorithms.nonfinite import NonFiniteCheck
from megastep.agents.algorithms.optimizers import (
    NAMES,
    THREADS,
    Adam,
    Factors,
    Imported,
    has_kernels,
    launches,
    squared_norms,
)
from megastep.agents.distributed import pooling
from megastep.agents.distributed.pooling import Moments, pool_with_condition
from megastep.agents.networks.fused import fused, is_plain_on_gpu
from megastep.agents.types import StateDict
from megastep.kernels.build.launch import Blocks, launch, without_early_starts

#: Bounds of a step size that follows the KL divergence, those of rsl_rl.
ADAPTIVE_LR = 1e-5, 1e-2


def _take_on_gpu(steps, is_enabled=True) -> torch.Tensor:
    """Decides whether a step is taken in two kernels, which also count it and its metrics."""
    adam, device = steps.optimizer, steps.lr.device
    sums, metrics = squared_norms(adam), [value.float() for value in steps.metrics.values()]
    is_first = steps.totals is None
    if is_first:
        steps.totals = sums.new_empty(len(metrics) + 3)
    grad_norm, is_taken = sums.new_empty(()), torch.empty_like(steps.is_finite)
    is_enabled = None if is_enabled is True else torch.as_tensor(is_enabled, device=device)
    launch(
        *(LIBRARY, "judge", device, Blocks(1, threads=THREADS)),
        metrics=b"".join(LIBRARY.params.MetricParams(values=value) for value in metrics),
        **dict(sums=sums, is_finite=steps.is_finite, is_enabled=is_enabled),
        **dict(n_valid=steps.n_valid, n_steps=adam.n_steps, grad_norm=grad_norm),
        **dict(is_taken=is_taken, totals=steps.totals, n_sums=len(sums)),
        **dict(n_metrics=len(metrics), is_first=int(is_first)),
    )
    adam.update(is_taken, grad_norm, steps.max_grad_norm)
    steps.metrics["grad_norm"] = grad_norm
    return is_taken


def _fits(steps, *_) -> bool:
    is_adam = isinstance(steps.optimizer, Adam) and has_kernels(steps.optimizer)
    return is_adam and len(steps.metrics) <= LIBRARY.constants["JUDGED_METRICS"]


@torch.no_grad()
def _average_on_gpu(parameters, n_valid, means=()) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Fills the bucket in one kernel, and divides it in another."""
    device, n_valid = n_valid.device, n_valid.long()
    held = [p for p in parameters if p.grad is not None]
    sources = [*(p.grad for p in held), *(mean.detach().float() for mean in means)]
    sizes = [x.numel() + -x.numel() % 4 for x in sources]
    bucket = torch.empty(sum(sizes) + 1, device=device)
    *parts, (total,) = bucket.split([*sizes, 1])
    averages = [part[: x.numel()].view_as(x) for part, x in zip(parts, sources)]
    rows = ((dict(source=x, target=average), {}) for x, average in zip(sources, averages))
    for packed, n_blocks in launches(LIBRARY.params.BucketRowParams, rows):
        launch(
            *(LIBRARY, "pack", device, Blocks(n_blocks, threads=THREADS)),
            **dict(rows=b"".join(packed), n_valid=n_valid, total=total, n_rows=len(packed)),
        )
    pooling.all_reduce(bucket)
    n, n_pooled = sum(sizes), torch.empty_like(n_valid)
    with without_early_starts():  # a kernel of NCCL comes before
        launch(
            *(LIBRARY, "divide", device, Blocks(-(-n // (4 * THREADS)), threads=THREADS)),
            **dict(bucket=bucket, total=total, n_valid=n_pooled, n=n),
        )
    for p, average in zip(held, averages):
        p.grad = average
    return n_pooled, averages[len(held) :]


def _takes_average(parameters, n_valid, means=()) -> bool:
    gradients = [p.grad for p in parameters if p.grad is not None]
    return pooling.n_pooled() > 1 and bool(gradients) and is_plain_on_gpu(*gradients)


average_gradients = fused(_average_on_gpu, _takes_average, operation=pooling.average_gradients)


@functools.cache
def one(device: torch.device) -> torch.Tensor:
    """Returns the gradient () of a loss itself: a loss that gets it has nothing to scale. The first
    learner makes it, as the members of a population read it on streams of their own.
    """
    return torch.ones((), device=device)


class GradientSteps:
    """Takes an optimizer's steps on some parameters. Skips steps with non-finite numbers.

        is_finite, _ = steps.begin(rollout.floats())
        for batch in minibatches:
            steps.backward(loss, metrics, batch.valid.sum())
            steps.take()
        return steps.end()

    With several ranks, gradients and metrics are those of all ranks' minibatches together, and all
    take or skip the same steps. Nothing changes if the rollout or the gradient is not finite, and
    nothing synchronises: conditions are bool tensors on the device.

    Args:
        parameters: parameters to optimise.
        lr: step size, a number, or a tensor () on the device, which is changed in place.
        max_grad_norm: longer gradients are scaled down to this norm.
        optimizer: one of `optimizers.NAMES`, or the import path of a class like those of
            `torch.optim`.
        lr_factors, weight_decays: as for `Adam`.
    """

    def __init__(
        self,
        parameters: Iterable[torch.nn.Parameter],
        lr: float | torch.Tensor,
        max_grad_norm: float,
        device: torch.device,
        optimizer: str = "adam",
        lr_factors: Factors | None = None,
        weight_decays: Factors | None = None,
    ):
        self.max_grad_norm = max_grad_norm
        self.lr = torch.as_tensor(lr, device=device)
        make = Adam if optimizer in NAMES else functools.partial(Imported, optimizer)
        factors: dict = dict(lr_factors=lr_factors or {}, weight_decays=weight_decays or {})
        self.optimizer: Adam | Imported = make(parameters, self.lr, **factors)
        self.check = NonFiniteCheck(device)
        one(self.lr.device)
        # of the update in progress; totals are those of metrics, then steps taken and skipped
        self.is_finite: torch.Tensor
        self.totals: torch.Tensor | None = None
        self.metrics: dict[str, torch.Tensor] = {}

    def follow_kl(self, kl: torch.Tensor, desired: float) -> None:
        """Divides the step size by 1.5 where the KL divergence is above twice a desired one, and
        multiplies it below half (rsl_rl, Rudin et al. 2022). It stays between `ADAPTIVE_LR`.
        """
        least, most = ADAPTIVE_LR
        lower, higher = (self.lr / 1.5).clamp(min=least), (self.lr * 1.5).clamp(max=most)
        lr = torch.where((kl < desired / 2) & (kl > 0), higher, self.lr)
        lr = torch.where(kl > 2 * desired, lower, lr)
        self.lr.copy_(torch.where(self.is_finite, lr, self.lr))

    def begin(
        self, floats: dict[str, torch.Tensor], *moments: Moments
    ) -> tuple[torch.Tensor, list[Moments]]:
        """Begins an update. Returns whether `floats`, the tensors to learn from, are all finite on
        every rank, () bool: if not, no step of this update is taken. And the moments of all ranks.
        """
        self.is_finite, pooled = pool_with_condition(self.check(floats), *moments)
        self.totals = None
        return self.is_finite, pooled

    def backward(
        self, loss: torch.Tensor, metrics: dict[str, torch.Tensor], n_valid: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """Computes the gradient of a loss (), a mean over the `n_valid` () valid transitions of a
        minibatch. Returns the metrics () of all ranks, which `end` averages over the steps taken.
        """
        parameters = self.optimizer.parameters
        for parameter in parameters:
            parameter.grad = None
        # as `loss.backward(one)` does it, which imports SymPy for half a second, to compare shapes
        options = dict(allow_unreachable=True, accumulate_grad=True)
        run_backward((loss,), (one(loss.device),), False, False, (), **options)
        n_valid, means = average_gradients(parameters, n_valid, [*metrics.values()])
        self.n_valid, self.metrics = n_valid.long(), dict(zip(metrics, means, strict=True))
        return self.metrics

    @fused(_take_on_gpu, _fits)
    def take(self, is_enabled: torch.Tensor | bool = True) -> torch.Tensor:
        """Takes one step down the gradient, and returns whether it did, () bool: only with valid
        transitions, and if enabled, () bool; else it is not counted as skipped.
        """
        grad_norm = self.optimizer.grad_norm()
        is_finite = grad_norm.isfinite() & self.is_finite
        is_taken = is_finite & is_enabled & (self.n_valid > 0)
        row = torch.stack([*self.metrics.values(), grad_norm]).masked_fill(~is_taken, 0.0)
        is_skipped = ~is_finite & is_enabled
        row = torch.cat([row, torch.stack([is_taken, is_skipped]).float()])
        self.totals = row if self.totals is None else self.totals + row
        self.optimizer.step(is_taken, grad_norm, self.max_grad_norm)
        self.metrics["grad_norm"] = grad_norm
        return is_taken

    def end(self) -> dict[str, torch.Tensor]:
        """Ends the update. Returns the metrics' means over the steps taken, and `skipped_steps`."""
        assert self.totals is not None
        n_taken, n_skipped = self.totals[-2], self.totals[-1]
        self.check.count((n_taken == 0) & (n_skipped > 0))
        means = (self.totals[:-2] / n_taken).unbind()
        return {**dict(zip(self.metrics, means, strict=True)), "skipped_steps": n_skipped}

    def copy_from(self, other: "GradientSteps") -> None:
        """Takes over the step size of others, and has skipped no update."""
        self.lr.copy_(other.lr)
        self.check.count(torch.zeros((), dtype=torch.bool, device=self.lr.device))

    def state_dict(self) -> StateDict:
        """Returns the optimizer's state, the step size and what `check` has counted."""
        check = self.check.state_dict()
        return dict(optimizer=self.optimizer.state_dict(), lr=self.lr.clone(), check=check)

    def load_state_dict(self, state: StateDict) -> None:
        """Continues from a `state_dict`."""
        self.optimizer.load_state_dict(state["optimizer"])
        self.lr.copy_(state["lr"])
        self.check.load_state_dict(state["check"])
