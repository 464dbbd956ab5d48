"""What an environment, a world and a policy have, as protocols for type checkers and readers.

Nothing inherits from them; any object with these attributes will do. :mod:`megastep.contract` checks
an environment at run time. B lanes, N environments, A agents per environment.
"""

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import torch

__all__ = ["Env", "Policy", "Space", "Tree", "World"]

#: A space of :mod:`megastep.spaces`, or a dict of them.
Space = Any
#: A tensor, or a dict of trees.
Tree = Any


class World(Protocol):
    """The dict that `reset` and `step` return, an :class:`~megastep.arrdict.arrdict` with a leading
    axis B. Worlds may also have `metrics` (a dict of (B,) float32, read where an episode ends),
    `learns` ((B,) bool) and `privileged` (what only a critic may see).
    """

    obs: Tree
    reward: torch.Tensor  # (B,) float32, for the transition that led here
    reset: torch.Tensor  # (B,) bool: the first observation of an episode
    terminal: torch.Tensor  # (B,) bool: the episode ended here by its own rule
    truncated: torch.Tensor  # (B,) bool: a time limit ended the episode here

    def __getitem__(self, key: str) -> Any: ...


@runtime_checkable
class Env(Protocol):
    """An environment: N copies of a game, stepped together on one device."""

    n_envs: int
    n_agents: int  # lanes per environment
    device: torch.device
    fps: float
    obs_space: Space
    action_space: Space

    def reset(self) -> World:
        """Starts every episode and returns the first world."""

    def step(self, decision: Mapping) -> World:
        """Takes ``decision["actions"]``, (B, ...) per leaf of the action space."""

    def check(self) -> None:
        """Raises the errors that were flagged on the device. Synchronises."""


@runtime_checkable
class Policy(Protocol):
    """Chooses actions from worlds, with a hidden state from step to step."""

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> Tree:
        """Returns the hidden state of B lanes at the start of an episode."""

    def __call__(
        self,
        world: World,
        state: Tree,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[Mapping, Tree]:
        """Returns (decision, next hidden state); the decision has `actions`."""
