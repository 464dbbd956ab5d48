"""Protocols of an environment, its worlds and a policy, for readers and type checkers.

No class needs to inherit from them: any object with these attributes is one.
:mod:`megastep.contract` checks an environment at run time. Axes: N environments, A agents per
environment that are controlled independently, B = N A lanes.
"""

from collections.abc import Iterator, Mapping
from typing import Any, Protocol, runtime_checkable

import torch

__all__ = ["Env", "Policy", "Space", "Tree", "World"]

#: A space of :mod:`megastep.spaces`, or a (nested) dict of spaces.
Space = Any
#: A tensor, or a (nested) dict of tensors.
Tree = Any


class World(Protocol):
    """The dict of tensors that ``reset`` and ``step`` return: an
    :class:`~megastep.arrdict.arrdict` with a leading axis B, whose keys are also attributes.

    Optional keys:
        metrics: dict of (B,) float32, statistics of an episode, read on its last step only.
        learns: (B,) bool, lanes whose transitions are used for learning. Default: all.
        privileged: per ``env.privileged_space``, inputs of the critic that no agent observes.
    """

    obs: Tree  # per env.obs_space
    reward: torch.Tensor  # (B,) float32, of the transition that led here
    reset: torch.Tensor  # (B,) bool: the first observation of an episode
    terminal: torch.Tensor  # (B,) bool: the episode ended here by its own rule
    truncated: torch.Tensor  # (B,) bool: a time limit ended the episode here

    def __getitem__(self, key: str) -> Any: ...

    def __iter__(self) -> Iterator[str]: ...

    def get(self, key: str, default: Any = None) -> Any: ...


@runtime_checkable
class Env(Protocol):
    """N copies of a game that are stepped together on one device.

    Optional attributes:
        layout: (N,) integers, the floor plan that each environment shows now. Confidence intervals
            of an evaluation are over layouts.
        bot: class of a scripted policy for this environment, whose arguments are settings of the
            environment. It plays as ``opponents.bot`` and ``against=bot``.
        roles: a name per agent, such as ``("leader", "follower")``. Metrics are reported by role.
        privileged_space: space of ``world.privileged``.
        state(e), plot_state(state): draw environment ``e``, for videos.
    """

    n_envs: int
    n_agents: int  # lanes per environment
    device: torch.device
    fps: float  # steps per second of simulated time
    obs_space: Space  # of one lane
    action_space: Space  # of one lane

    def reset(self) -> World:
        """Starts a new episode in every lane. Returns the first world."""

    def step(self, decision: Mapping) -> World:
        """Takes one step by ``decision["actions"]``, (B, ...) per leaf of the action space."""

    def check(self) -> None:
        """Raises the errors that were flagged on the device. Synchronises host and device."""


@runtime_checkable
class Policy(Protocol):
    """Chooses actions from worlds, and carries a hidden state from step to step."""

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> Tree:
        """Returns the hidden state of ``n_lanes`` lanes at the start of an episode."""

    def __call__(
        self,
        world: World,
        state: Tree,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[Mapping, Tree]:
        """Returns (decision, next hidden state). The decision has the key ``actions``.

        Args:
            world: the current world.
            state: the hidden state before this step.
            sample: draw from the action distribution; otherwise take the most likely action.
            generator: random number generator of the draws.
        """
