"""Protocols of an environment, its worlds and a policy, and the defaults of what is optional.

No class needs to inherit from the protocols: any object with these attributes is one.
:mod:`megastep.contract` checks an environment at run time. Axes: N environments, A agents per
environment that are controlled independently, B = N A lanes.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

if TYPE_CHECKING:  # processes of environments do without PyTorch
    import torch

__all__ = [
    "DEFAULTS",
    "Env",
    "PolicyLike",
    "Space",
    "Tree",
    "World",
    "n_lanes",
    "optional",
    "takes_masks",
]

#: A space of :mod:`megastep.spaces`, or a (nested) dict of spaces.
Space = Any
#: A tensor, or a (nested) dict of tensors.
Tree = Any
#: Floor plans, each a dotdict; see `megastep.geometry`.
Geometries = Sequence[Any]


class World(Protocol):
    """The dict of tensors that ``reset`` and ``step`` return: an
    :class:`~megastep.arrdict.arrdict` with a leading axis B, whose keys are also attributes.

    Keys:
        obs: per ``env.obs_space``.
        reward: (B,) float32, of the transition that led here.
        reset: (B,) bool: the first observation of an episode.
        terminal: (B,) bool: the episode ended here by its own rule.
        truncated: (B,) bool: a time limit ended the episode here.

    Optional keys:
        metrics: dict of (B,) float32, statistics of an episode, read on its last step only.
        learns: (B,) bool, lanes whose transitions are used for learning. Default: all.
        mask: per discrete action space (B, A, n) bool, the actions allowed in the state that `obs`
            shows, at least one.
        privileged: per ``env.privileged_space``, inputs of the critic that no agent observes.
    """

    def __getattr__(self, name: str) -> Tree: ...

    def __getitem__(self, key: str, /) -> Tree: ...

    def __iter__(self) -> Iterator[str]: ...

    def get(self, key: str, default: Tree = None, /) -> Tree:
        """Returns an entry, or the default if it is absent."""


@runtime_checkable
class Env(Protocol):
    """N copies of a game that are stepped together on one device.

    Optional attributes have their defaults in ``DEFAULTS``, with which :func:`optional` reads them;
    docs/new-environment.md describes them under The contract.
    """

    n_envs: int
    device: torch.device
    obs_space: Space  # of one lane
    action_space: Space  # of one lane

    def reset(self) -> World:
        """Starts a new episode in every lane. Returns the first world."""
        ...

    def step(self, decision: Mapping) -> World:
        """Takes one step by ``decision["actions"]``, (B, ...) per leaf of the action space."""
        ...


#: Optional attributes of an environment, with their defaults.
DEFAULTS: dict[str, Any] = {
    "n_agents": 1,
    "fps": 10.0,
    "capturable": True,
    "coefficients": (),  # `Coefficients`, whose schedules training follows
    "resumable": True,
    "close": lambda: None,
    # what wrappers have learnt, tensors and numbers by name, which belongs to the policy; another
    # environment is given it, and whether it is frozen
    "wrapper_state": dict,
    "load_wrapper_state": None,
    "max_episode_steps": 100_000,
    "check": lambda: None,
    "layout": None,
    "weigh_layouts": None,
    "bot": None,
    "controls": None,  # {key of a keyboard: action}, for a page of `megastep web`
    "roles": None,
    "privileged_space": None,
    "desync": None,
    "game_over": None,
    "truth": None,  # a method: what no agent observes, (B, ...) by name, for datasets
    # of environments with opponents
    "learners": None,  # (B,) bool, lanes whose transitions are stored; None: all
    "matchups": {},  # (B,) bool by name, groups of lanes that are reported apart
    "opponent_pool": None,  # an `Opponents` of agents.selfplay
    "begin_step": lambda: None,  # starts what a step can do before its actions are known
}


def optional(owner: object, name: str, defaults: Mapping[str, Any] = DEFAULTS) -> Any:
    """Returns an optional attribute of an environment, or of another owner, or its default."""
    return getattr(owner, name, defaults[name])


def takes_masks(env: Env) -> bool:
    """Returns whether an environment has ``reset(seed=None, mask=None)``."""
    own = getattr(env, "takes_masks", None)  # of a wrapper, which depends on what is inside
    return {"seed", "mask"} <= {*inspect.signature(env.reset).parameters} if own is None else own


def n_lanes(env: Env) -> int:
    """Returns the number of lanes of an environment, B = N A."""
    return env.n_envs * optional(env, "n_agents")


@runtime_checkable
class PolicyLike(Protocol):
    """Chooses actions from worlds, and carries a hidden state from step to step.

    Optional attribute:
        capturable: True if a CUDA graph can repeat its calls: it never waits for the device, and
            what changes is in tensors. Evaluations on a GPU replay such policies. Default: True for
            classes of megastep.
    """

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> Tree:
        """Returns the hidden state of ``n_lanes`` lanes at the start of an episode."""
        ...

    def __call__(
        self,
        world: World,
        state: Tree,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[Mapping, Tree]:
        """Returns (decision, next hidden state), from the hidden state before this step. The
        decision has the key ``actions``: drawn from their distribution, or with ``sample=False``
        the most likely.
        """
        ...
