"""Saving a run: a checkpoint now and then, and what to say when one cannot be written."""

import shutil
import warnings
from pathlib import Path
from typing import Any

import torch
from torch.utils._pytree import tree_leaves, tree_map_only

from megastep.agents.algorithms.nonfinite import NonFiniteError, nonfinite_leaf
from megastep.agents.training import checkpoint


class Saver:
    """Writes the checkpoints of one run into a folder, with the `config` that it runs under.

    A disk that is full or not writable is a warning, the first time, and the next call tries again.
    Until one succeeds, `unsaved` is the sentence that says why the last checkpoint is missing. A
    state that is not finite is never written: NonFiniteError, and the checkpoints before it stay.
    """

    def __init__(self, folder: Path, config: dict[str, Any], keep: int = 2):
        self.folder, self.config, self.keep = folder, config, keep
        self.unsaved = None

    def __call__(self, step: int, state: dict[str, Any], score: float | None = None) -> bool:
        """Saves `state`, dicts of tensors and numbers, after `step` samples; whether it could."""
        # first of all to the CPU: a GPU may have no memory left
        state = tree_map_only(torch.Tensor, lambda leaf: leaf.detach().cpu(), state)
        if path := nonfinite_leaf(state):
            raise NonFiniteError(
                f"The checkpoint at {step:,} samples was not saved, for {path} is not finite"
            )
        try:
            checkpoint.save(self.folder, step, state, self.config, self.keep, score)
        except OSError as error:
            warned = self.unsaved is not None
            self.unsaved = self._explain(step, state, error)
            if not warned:
                warnings.warn(
                    f"{self.unsaved}; training goes on and the next checkpoint tries again",
                    stacklevel=2,
                )
            return False
        self.unsaved = None
        return True

    def _explain(self, step, state, error):
        needed = sum(getattr(leaf, "nbytes", 0) for leaf in tree_leaves(state))
        free = shutil.disk_usage(self.folder.parent).free
        return (
            f"The checkpoint at {step:,} samples could not be saved ({error.strerror}): it needs "
            f"about {needed / 1e6:.1f} MB, and {free / 1e6:.1f} MB are free in {self.folder.parent}"
        )


class Snapshots:
    """Keeps a run's weights at the ends of `n` equal parts of its budget, with a `Saver` of its
    own: what `evaluate.py ratings=true` compares. A trainer calls it with itself.
    """

    def __init__(self, save: Saver, n: int):
        self.save, self.n, self.n_past = save, n, None

    def __call__(self, trainer: Any) -> None:
        n_past = int((1 - trainer.left) * self.n + 1e-9)
        if self.n_past is not None and n_past > self.n_past:
            self.save(trainer.samples, {"policy": trainer.policy.state_dict()})
        self.n_past = n_past
