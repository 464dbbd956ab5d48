"""Saves snapshots of the weights at even intervals of the budget."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from megastep.agents.runs.saver import Saver
    from megastep.agents.training.trainer import Trainer


class SnapshotSaver:
    """Saves what the policy acts with at the end of each of `n` equal parts of the budget.

    `evaluate.py ratings=true` compares these snapshots. :class:`Trainer` calls it once per update.

    Args:
        saver: writes the snapshots.
        n: number of snapshots; 0 for none.
    """

    def __init__(self, saver: Saver, n: int):
        self.saver, self.n = saver, n
        self.n_parts_done = None

    def __call__(self, trainer: Trainer) -> None:
        n_parts_done = int((1 - trainer.fraction_left) * self.n + 1e-9)
        if self.n_parts_done is not None and n_parts_done > self.n_parts_done:
            self.saver(trainer.samples, trainer.run_state.of_policy())
            self.saver.wait()
        self.n_parts_done = n_parts_done
