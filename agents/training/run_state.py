"""Gathers the state of a run for a checkpoint, and restores it when the run is resumed."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

from megastep.agents.training.budget import evaluation_in
from megastep.agents.types import CollectorOptions, with_defaults
from megastep.env_state import EnvState
from megastep.types import optional

if TYPE_CHECKING:
    from megastep.agents.training.trainer import Trainer
    from megastep.agents.types import StateDict


class RunState:
    """The state of a run: what trains, and the trainer's counters, after the first reset."""

    def __init__(self, trainer: Trainer):
        self.trainer = trainer
        self.collect = with_defaults(trainer.collect, CollectorOptions)
        self.opponents = optional(trainer.env, "opponent_pool")
        if self.opponents is None:
            self.env_state = EnvState(trainer.env)
        else:
            self.env_state = EnvState(self.opponents.env, self.opponents.scripted)
        self.is_resumable = optional(self.env_state.env, "resumable")  # checkpoints hold it
        self.has_named_unreachable = False

    def state_dict(self, has_episodes: bool = True) -> StateDict:
        """Returns the state, most of it no copies; with episodes, environment and actor."""
        trainer = self.trainer
        parts = dict(
            samples=trainer.samples,
            updates=trainer.updates,
            seconds=trainer.clock.seconds,
            samples_at_report=trainer.samples_at_report,
            **{f"eval/{name}": value for name, value in trainer.evaluation.items()},
            **self.of_policy(),
            learner=trainer.learner.state_dict(),
            episode_stats=trainer.episodes.stats.state_dict(),
        )
        if has_episodes and self.is_resumable:
            parts["env"] = self.env_state.state_dict()
            parts["collector"] = self.collect.state_dict()
        others = dict(opponents=self.opponents, curriculum=trainer.curriculum)
        others["replay"] = trainer.learner_options.replay_buffer
        return parts | {k: part.state_dict() for k, part in others.items() if part is not None}

    def of_policy(self) -> StateDict:
        """Returns the policy's weights, and what wrappers of the environment have learnt."""
        wrappers = optional(self.env_state.env, "wrapper_state")()
        learnt = {"wrappers": wrappers} if wrappers else {}
        return dict(policy=self.trainer.policy.state_dict(), **learnt)

    def load_state_dict(self, state: StateDict, is_new_rank: bool = False) -> None:
        """Restores a `state_dict`; `trainer.lost` gets a clause for each part that starts anew."""
        trainer = self.trainer
        trainer.samples, trainer.updates = state["samples"], state["updates"]
        trainer.clock.seconds_before = state["seconds"]
        trainer.samples_at_report = state["samples_at_report"]
        trainer.evaluation = evaluation_in(state)
        trainer.updates_at_checkpoint = trainer.updates_at_report = trainer.updates
        if is_new_rank:  # with generators of its own
            own = self.state_dict(has_episodes=False)
            names = [name for name in ("learner", "opponents") if name in state]
            state = {**state, **{k: _with_generators(state[k], own[k]) for k in names}}
        trainer.policy.load_state_dict(state["policy"])
        trainer.learner.load_state_dict(state["learner"])
        lost = self._load_episodes(state)
        if self.opponents is not None:
            parts = state["opponents"]
            if lost:
                parts = {name: part for name, part in parts.items() if name != "lanes"}
            self.opponents.load_state_dict(parts)
        if trainer.curriculum is not None:
            trainer.curriculum.load_state_dict(state["curriculum"])
        if (replay := trainer.learner_options.replay_buffer) is not None:
            if "replay" in state:
                replay.load_state_dict(state["replay"])
            else:
                lost.append("the replay buffer was not saved and starts empty")
        trainer.lost = ["added ranks start new episodes"] if is_new_rank else lost

    def _load_episodes(self, state) -> list[str]:
        """Restores env, actor state and episode statistics. Returns what is lost."""
        lost = []
        if "env" not in state:
            lost.append("environments were not saved, so new episodes start")
        elif not state["collector"]:
            kind = type(self.trainer.collect).__name__
            lost.append(f"{kind} has no state_dict, so new episodes start")
        else:
            try:
                self.env_state.load_state_dict(state["env"])
            except ValueError as error:
                lost.append(f"{error}; new episodes start")
        if not lost:
            self.collect.load_state_dict(state["collector"])
        elif "wrappers" in state:
            optional(self.env_state.env, "load_wrapper_state")(state["wrappers"], False)
        self.trainer.episodes.stats.load_state_dict(state["episode_stats"], not lost)
        return lost

    def warn_of_unreachable(self) -> None:
        """Warns once of environment state that checkpoints cannot hold."""
        if self.has_named_unreachable or not self.is_resumable or self.trainer.ranks.rank > 0:
            return
        if names := self.env_state.unreachable():
            self.has_named_unreachable = True
            warnings.warn(
                f"Checkpoints cannot hold {', '.join(names)} of the environment: if they change, a "
                "resumed run differs from an uninterrupted one",
                stacklevel=3,
            )


def _with_generators(saved, own) -> object:
    """Returns a saved state whose `SeededGenerator` states are replaced by those of `own`."""
    if not isinstance(saved, dict) or not isinstance(own, dict):
        return saved
    if "seed" in saved and saved.keys() <= {"seed", "device", "generator"}:
        return own
    return {name: _with_generators(part, own.get(name)) for name, part in saved.items()}
