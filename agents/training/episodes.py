"""What training does with the episodes of each rollout: counts them, and gives the curriculum and
the opponents their share.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch

from megastep.agents.algorithms.cuda_graph import CudaGraphUpdate
from megastep.agents.storage.rollout import Rollout
from megastep.agents.training.episode_stats import MIN_EPISODES, EpisodeStats, lane_groups
from megastep.types import optional

if TYPE_CHECKING:
    from megastep.agents.training.trainer import Trainer


class Episodes:
    """Counts the episodes of a trainer, whose environment has been reset, on a GPU as a CUDA graph.

    Attributes:
        stats: the statistics.
        opponents: those of the environment, or None.
    """

    def __init__(self, trainer: Trainer):
        self.opponents = optional(trainer.env, "opponent_pool")
        device = torch.device(trainer.env.device)
        self.graph = CudaGraphUpdate(self.count, device, graph=True)
        self.counted_tensors: list[torch.Tensor | None] = []
        self.begin(trainer)

    def begin(
        self, trainer: Trainer, sources: Sequence[str] | None = None, desync: bool = False
    ) -> None:
        """Begins to count, before the first update.

        Args:
            sources: the name of the source of each layout of the environment, whose episodes have
                statistics of their own.
            desync: starts the first episodes at random ages, if the environment has a method
                `desync()`, and leaves them out.
        """
        env, rollout = trainer.env, trainer.rollout
        allocate_layouts = getattr(trainer.collect, "allocate_layouts", None)
        if optional(env, "layout") is None or not allocate_layouts:
            sources = None
        elif sources:
            allocate_layouts()
        if desync := desync and optional(env, "desync") is not None:
            optional(env, "desync")()
        groups = lane_groups(env, rollout.learners)
        self.stats = EpisodeStats(
            rollout.n_lanes, env.device, tuple(rollout.metrics), groups, desync, sources
        )

    @property
    def names(self) -> list[str]:
        """The means over episodes that reports may have, without `episode/`."""
        kinds = [] if self.opponents is None else [*self.opponents.matchups]
        return [*self.stats.names, *(f"won/{kind}" for kind in kinds if kind != "now")]

    def on_update(self, trainer: Trainer, losses: object) -> None:
        """Counts episodes, and has curriculum and opponents learn from them."""
        rollout = trainer.rollout
        (self.graph if self._keeps_tensors(rollout) else self.count)(rollout)
        if trainer.curriculum is not None:
            trainer.curriculum.update(rollout)
        if self.opponents is not None:
            self.opponents.refresh_snapshots(trainer.policy, trainer.updates)

    def _keeps_tensors(self, rollout) -> bool:
        """Returns whether a rollout is where it was at the first update, as a CUDA graph wants it.
        A user's own rollout may replace its tensors, and so may a callback.
        """
        if type(rollout) is not Rollout:
            return False
        names = "reward", "starts", "terminal", "truncated", "learns", "layouts"
        tensors = [getattr(rollout, name) for name in names] + [*rollout.metrics.values()]
        self.counted_tensors = self.counted_tensors or tensors
        return all(map(operator.is_, tensors, self.counted_tensors))

    def count(self, rollout: Rollout) -> dict[str, torch.Tensor]:
        """Counts the episodes of a rollout. Returns no metrics."""
        self.stats.add(
            rollout.reward,
            rollout.reset,
            rollout.terminal | rollout.truncated,
            rollout.learns[:-1],
            rollout.metrics,
            rollout.layouts if self.stats.sources else None,
        )
        return {}

    def on_measure(self, trainer: Trainer, metrics: dict[str, Any]) -> None:
        """Adds the statistics since the last report. Synchronises."""
        stats = self.stats.pop(trainer.ranks.sum)
        if self.opponents is not None:
            stats |= self.opponents.pop_win_rates(trainer.ranks.sum)
        if trainer.curriculum is not None:
            stats |= trainer.ranks.mean(trainer.curriculum.stats())
        trainer.latest_stats |= stats
        metrics |= stats
        if stats.get("episode/window", 0) >= MIN_EPISODES:
            trainer.score = stats["episode/return"]
