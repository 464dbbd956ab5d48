"""Warns of the first NaN or infinity of a run, and ends the run if they persist.

The learner skips such updates, see `nonfinite.NonFiniteCheck`.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.distributed.process_group import rank_label
from megastep.agents.distributed.ranks import ONE, Ranks
from megastep.agents.types import LearnerOptions, with_defaults
from megastep.types import Env, optional

if TYPE_CHECKING:
    from megastep.agents.training.trainer import Trainer
    from megastep.agents.types import Learner, RolloutLike

#: Training stops after this many skipped updates in a row.
MAX_SKIPPED = 20


class NonFiniteGuard:
    """Warns of the first NaN or infinity of a run, and ends a run whose updates are all skipped.
    All ranks call it at the same updates; they exchange what they found.

    Args:
        learner: its `check` is read, if it has one.

    Attributes:
        value: the first NaN or infinity of the run, or None.
        tolerates_divergence: a policy that diverged is noted in `has_diverged`, and raises nothing,
            for whoever replaces it. Its updates are skipped, so its weights stay as they are.
        has_diverged: the last `MAX_SKIPPED` updates were skipped.
    """

    tolerates_divergence = has_diverged = False

    def __init__(self, env: Env, learner: Learner, ranks: Ranks = ONE):
        self.learner, self.ranks = learner, ranks
        self.n_agents = optional(env, "n_agents")
        self.nonfinite_check = with_defaults(learner, LearnerOptions).check
        self.value = None

    def on_report(self, trainer: Trainer, metrics: object) -> None:
        """Checks the last update."""
        self.check(trainer.rollout)

    def may_save(self, trainer: Trainer) -> bool:
        """Returns whether the last update was applied, or the policy is about to be replaced: the
        last checkpoint precedes a NaN.
        """
        return self.tolerates_divergence or self.check(trainer.rollout)

    def check(self, rollout: RolloutLike) -> bool:
        """Returns True if the last update was applied, False if it was skipped. Synchronises.

        Raises:
            NonFiniteError: the last `MAX_SKIPPED` updates were all skipped.
        """
        if self.nonfinite_check is None:
            return True
        value, n_skipped = self.nonfinite_check.read(rollout.floats())
        if value:
            stored = rollout.learners  # of the environment's lanes
            lanes = range(rollout.n_lanes) if stored is None else stored.nonzero()[:, 0].tolist()
            value = value.in_env(lanes, self.n_agents)
        is_bad = value is not None or n_skipped > 0
        reports = self.ranks.gather_if_any((n_skipped, value, rank_label()), is_bad)
        n_skipped = max(report[0] for report in reports)
        _, value, label = next((one for one in reports if one[1]), reports[0])
        text = f"{value}{f' ({label})' * (len(reports) > 1)}"
        if value and self.value is None:
            self.value = value
            if self.ranks.rank == 0:
                warnings.warn(f"{text}; its rollout was skipped", stacklevel=2)
        self.has_diverged = n_skipped >= MAX_SKIPPED
        if not self.has_diverged:
            return n_skipped == 0
        is_from_env = value is not None and value.is_from_env
        if self.tolerates_divergence and not is_from_env:
            return False
        advice = f"The policy diverged: try a learning rate smaller than {self.learner.lr:g}"
        if value is not None and is_from_env:
            advice = f"It came from the environment: check how it computes {value.name}"
        raise NonFiniteError(
            f"The last {n_skipped} updates were skipped because of numbers that were not finite or "
            f"too large ({text if value else 'gradients'}). {advice}",
            is_from_env,
        )
