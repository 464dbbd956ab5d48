"""The gradient steps of an update: followed if they are finite, counted if they are not."""

from collections.abc import Iterable
from typing import Any

import torch

from megastep.agents.algorithms.adam import Adam
from megastep.agents.algorithms.nonfinite import NonFiniteCheck


class GradientSteps:
    """Adam's steps on some parameters, none of them with a number that is not finite.

        is_fine = steps.begin(rollout.numbers())
        for batch in minibatches:
            steps.take(loss, metrics, batch.valid.any())
        return steps.end()

    A rollout with a number that is not finite, or beyond `finite.LIMIT`, and a gradient that is not
    finite change nothing. `check` tells which number it was, and how many updates were skipped in a
    row. Nothing synchronises: what would be an `if` is a flag on the device.

    Args: `lr`, Adam's step size; `max_grad_norm`, to which longer gradients are shortened.
    """

    def __init__(
        self,
        parameters: Iterable[torch.nn.Parameter],
        lr: float,
        max_grad_norm: float,
        device: torch.device,
    ):
        self.max_grad_norm = max_grad_norm
        self._lr = torch.tensor(lr, device=device)
        self.optimizer = Adam(parameters, self._lr)
        self.check = NonFiniteCheck(device)
        self._is_fine, self._rows, self._names = None, [], ()  # of the update that goes on

    def set_lr(self, lr: float) -> None:
        """Changes Adam's step size, also for a captured update."""
        self._lr.fill_(lr)

    def begin(self, numbers: dict[str, torch.Tensor]) -> torch.Tensor:
        """Begins an update that learns from these numbers, as `NonFiniteCheck` takes them. Returns
        whether it can, a bool ().
        """
        self._is_fine, self._rows = self.check(numbers), []
        return self._is_fine

    def take(
        self,
        loss: torch.Tensor,
        metrics: dict[str, torch.Tensor],
        has_valid: torch.Tensor,
        is_wanted: torch.Tensor | bool = True,
    ) -> torch.Tensor:
        """One step down a loss (), if it has a valid row, and is wanted: a step that is not is not
        counted as skipped either. `metrics` are tensors () by name, of which `end` gives the means.
        Returns whether the step was taken, a bool ().
        """
        self.optimizer.zero_grad()
        loss.backward()
        grad_norm = torch.nn.utils.clip_grad_norm_(self.optimizer.parameters, self.max_grad_norm)
        finite = grad_norm.isfinite() & self._is_fine
        taken = finite & is_wanted & has_valid
        self.optimizer.step(taken)
        metrics = dict(metrics, grad_norm=grad_norm)
        row = torch.stack([value.detach() for value in metrics.values()]).masked_fill(~taken, 0.0)
        self._rows.append(torch.cat([row, torch.stack([taken, ~finite & is_wanted]).float()]))
        self._names = tuple(metrics)
        return taken

    def end(self) -> dict[str, torch.Tensor]:
        """Ends the update. Returns the means of the metrics over the steps that were taken, and
        `skipped_steps`, how many were not finite.
        """
        *sums, n_taken, n_skipped = sum(self._rows).unbind()
        self.check.count((n_taken == 0) & (n_skipped > 0))
        means = {name: total / n_taken for name, total in zip(self._names, sums, strict=True)}
        return {**means, "skipped_steps": n_skipped}

    def state_dict(self) -> dict[str, Any]:
        return dict(optimizer=self.optimizer.state_dict(), lr=self._lr.clone())

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.optimizer.load_state_dict(state["optimizer"])
        self._lr.copy_(state["lr"])
