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

    Optional attributes, whose defaults are in ``DEFAULTS``; read them with :func:`optional`:
        n_agents: number of lanes per environment, A.
        fps: steps per second of simulated time, for videos.
        capturable: False if it steps on the host, where no CUDA graph can repeat a step.
        resumable: False if a checkpoint cannot hold its state: a resumed run begins new episodes.
        check(): raises the errors that were flagged on the device. Synchronises host and device.
        layout: (N,) integers, the floor plan that each environment shows now. Confidence intervals
            of an evaluation are over layouts; without, they are over environments.
        weigh_layouts(): has new episodes take place in layouts drawn by weights from now on.
            Returns the cumulative weights, (D,) int32 on the device, which a curriculum changes in
            place.
        bot: class of a scripted policy for this environment, whose arguments are settings of the
            environment, or `env`, the environment itself. It plays as ``opponents.bot`` and
            ``against=bot``.
        controls: {key of a keyboard: action}, by which a person drives an agent in a page that
            ``megastep web`` writes. Default: movement by arrow keys, or digits.
        roles: a name per agent, such as ``("leader", "follower")``. Metrics are reported by role.
        privileged_space: space of ``world.privileged``.
        coefficients: a tuple of `megastep.coefficients.Coefficients`, such as weights of rewards,
            which training has follow their schedules.
        close(): ends what it started, such as processes. Called after training.
        wrapper_state(), load_wrapper_state(state, is_frozen): what wrappers around the environments
            have learnt, such as running statistics, as tensors and numbers by name. It belongs to
            the policy: evaluations give it to their environments and freeze it.
        max_episode_steps: steps at which an evaluation cuts an episode off.
        reset(seed=None, mask=None): a reset that takes a seed and a mask. With a mask, (B,) bool,
            only these lanes begin an episode; the others keep state and observation to the bit, and
            their rows are those of the last world. With a seed, an integer or (B,) int64, a seed
            per lane, the episodes from now on are the same each time. Neither synchronises. See
            :func:`takes_masks`.
        game_over: (N,) bool, environments whose game ended with the last world, and with it the
            episodes of all agents. Default: where all lanes of one end at once.
        desync(): gives every lane a random age, as if its episode had been going on for some steps,
            so that lanes do not end their episodes in the same steps. Called after ``reset``.
        state(e), plot_state(state): draw environment ``e``. Without them there are no videos.
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
    "coefficients": (),
    "resumable": True,
    "close": lambda: None,
    "wrapper_state": dict,
    "load_wrapper_state": None,
    "max_episode_steps": 100_000,
    "check": lambda: None,
    "layout": None,
    "weigh_layouts": None,
    "bot": None,
    "controls": None,
    "roles": None,
    "privileged_space": None,
    "desync": None,
    "game_over": None,
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
    return (
        own if own is not None else {"seed", "mask"} <= {*inspect.signature(env.reset).parameters}
    )


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
