"""Saving a run: checkpoints at intervals, and snapshots of the weights spaced over the budget."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch.utils._pytree import tree_leaves, tree_map_only

from megastep.agents.algorithms.nonfinite import NonFiniteError, nonfinite_leaf
from megastep.agents.training import checkpoint

if TYPE_CHECKING:
    from megastep.agents.training.trainer import Trainer

#: The parts of a state that must be finite. What comes from the environment need not be.
LEARNED = ("policy", "learner", "opponents")


class Saver:
    """Writes the checkpoints of one run.

    A full, read-only or faulty disk causes one warning; each later call tries again.

    Args:
        folder: where the checkpoints go.
        config: the run's configuration, stored in each checkpoint.
        keep_checkpoints: number of checkpoints kept, besides the one with the best score.

    Attributes:
        error: why the last checkpoint could not be written, as a sentence; None if it was written.
    """

    def __init__(self, folder: Path, config: dict[str, Any], keep_checkpoints: int = 2):
        self.folder, self.config, self.keep_checkpoints = folder, config, keep_checkpoints
        self.error = None

    def __call__(self, step: int, state: dict[str, Any], score: float | None = None) -> bool:
        """Writes a checkpoint of `state` after `step` environment steps. Returns True if it could.

        Args:
            state: dicts and lists of tensors and numbers.
            score: for example the mean return, higher is better; None if unknown.

        Raises:
            NonFiniteError: what was learnt holds a NaN or infinity. Earlier checkpoints are kept.
        """
        # copied to the CPU first: the GPU may have no memory left for the check
        state = tree_map_only(torch.Tensor, lambda leaf: leaf.detach().cpu(), state)
        if path := nonfinite_leaf({name: state.get(name) for name in LEARNED}):
            raise NonFiniteError(
                f"The checkpoint at {step:,} samples was not saved: {path} is not finite"
            )
        try:
            checkpoint.save(self.folder, step, state, self.config, self.keep_checkpoints, score)
        except (OSError, checkpoint.DamagedCheckpoint) as error:
            has_warned = self.error is not None
            self.error = self._message(step, state, error)
            if not has_warned:
                warnings.warn(
                    f"{self.error}. Training goes on; the next checkpoint tries again",
                    stacklevel=2,
                )
            return False
        self.error = None
        return True

    def _message(self, step, state, error):
        reason = getattr(error, "strerror", None) or str(error)
        n_bytes = sum(getattr(leaf, "nbytes", 0) for leaf in tree_leaves(state))
        sentence = (
            f"The checkpoint at {step:,} samples could not be saved ({reason}): it needs about "
            f"{n_bytes / 1e6:.1f} MB"
        )
        try:
            free_bytes = shutil.disk_usage(self.folder.parent).free
        except OSError:
            return f"{sentence} in {self.folder.parent}, which cannot be read"
        return f"{sentence}, and {free_bytes / 1e6:.1f} MB are free in {self.folder.parent}"


class SnapshotSaver:
    """Saves the policy's weights at the end of each of `n` equal parts of the budget.

    `evaluate.py ratings=true` compares these snapshots. :class:`Trainer` calls it with itself.

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
            self.saver(trainer.samples, {"policy": trainer.policy.state_dict()})
        self.n_parts_done = n_parts_done
