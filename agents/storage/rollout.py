"""Rollouts: T steps of B lanes on the device, and how they are collected.

Axes: T time, B lanes, M lanes of a minibatch. Row t of a rollout is the observation and the action
of time t; `reward`, `reset`, `terminal` and `truncated` at row t are those of the world that
followed, t+1. So row t is a valid transition unless its `reset` is set.
"""

import math
from typing import Any

import torch

from megastep import spaces
from megastep.arrdict import arrdict, clone
from megastep.capture import capture
from megastep.dotdict import leaves, mapping


def _zeros(space, lead, device, dtype):
    """Zeros for values of a tree of spaces, after `lead` axes: of the dtype that a space names,
    int64 for its integers, else of `dtype`.
    """
    if isinstance(space, dict):
        return arrdict({key: _zeros(child, lead, device, dtype) for key, child in space.items()})
    if isinstance(space, spaces.MultiDiscrete):
        dtype = torch.int64
    dtype = getattr(space, "dtype", None) or dtype
    return torch.zeros(*lead, *space.shape, dtype=dtype, device=device)


def _floats(tree, name):
    """The leaves of a tree that are not integers, by their paths below `name`."""
    if isinstance(tree, dict):
        parts = (_floats(child, f"{name}.{key}") for key, child in tree.items())
        return {path: leaf for part in parts for path, leaf in part.items()}
    return {name: tree} if tree.is_floating_point() else {}


class Rollout:
    """T steps of B lanes, in memory that is allocated once and overwritten by every `collect`.

    obs        (T+1, B, ...), the last row is the observation that the next rollout starts from
    privileged (T+1, B, ...) float32, what the critic alone sees, or None where there is no such
               space
    starts     (T+1, B) bool, whether that observation is its episode's first
    learns     (T+1, B) bool, whether the learner learns from the lane then; all do unless worlds
               say otherwise
    actions    (T, B, ...) int64
    logprobs   (T, B) of those actions, under the policy that chose them; 0 of one that gives none
    values     (T+1, B), as the policy's critic estimated them then, or None if nobody needs them
    reward     (T, B), and `terminal`, `truncated` (T, B) bool: of the world that followed
    metrics    by name, (T, B) float32: of the world that followed, where an episode ended
    state      the policy's state before row 0, leaves (B, ...)

    Args: `state`, the policy's state of B lanes, such as `policy.initial(B)`, of which a copy is
    made; `obs_dtype`, of all observations that are not integers and whose space names none;
    `learners`, for an environment where opponents play too, which of its lanes are the B that are
    stored, a bool each; `values`, whether there are any. ValueError if it has no row.
    """

    def __init__(
        self,
        n_steps: int,
        n_lanes: int,
        obs_space: Any,
        action_space: Any,
        state: arrdict,
        device: torch.device | str | None = None,
        privileged_space: Any = None,
        obs_dtype: torch.dtype = torch.float16,
        learners: torch.Tensor | None = None,
        values: bool = True,
    ):
        if n_steps < 1 or n_lanes < 1:
            raise ValueError(
                f"a rollout needs at least one step and one lane, not {n_steps} and {n_lanes}"
            )
        self.n_steps, self.n_lanes, self.learners = n_steps, n_lanes, learners
        self.stored = None if learners is None else learners.nonzero()[:, 0]
        rows, more = (n_steps, n_lanes), (n_steps + 1, n_lanes)
        self.obs = _zeros(obs_space, more, device, obs_dtype)
        self.privileged = None
        if privileged_space is not None:
            self.privileged = _zeros(privileged_space, more, device, torch.float32)
        self.actions = _zeros(action_space, rows, device, torch.int64)
        self.starts = torch.zeros(more, dtype=torch.bool, device=device)
        self.learns = torch.ones(more, dtype=torch.bool, device=device)
        self.terminal = torch.zeros(rows, dtype=torch.bool, device=device)
        self.truncated = torch.zeros(rows, dtype=torch.bool, device=device)
        self.values = torch.zeros(more, device=device) if values else None
        self.logprobs = torch.zeros(rows, device=device)
        self.reward = torch.zeros(rows, device=device)
        self.metrics = arrdict()
        self.state = clone(state)

    def make_room(self, world: arrdict) -> None:
        """For the metrics of worlds like this one, before the first is stored."""
        for name in world.get("metrics", {}):
            self.metrics[name] = torch.zeros_like(self.reward)

    @property
    def reset(self) -> torch.Tensor:
        """(T, B) bool: whether row t's action was ignored because an episode started instead."""
        return self.starts[1:]

    def copy_(self, other: "Rollout") -> None:
        """Takes over all that another one of the same kind holds."""
        for own, its in zip(self._tensors(), other._tensors(), strict=True):
            own.copy_(its)

    def _tensors(self):
        parts = [getattr(self, name) for name in (*_SEQUENCES, "privileged", "values")]
        kept = {str(i): part for i, part in enumerate(parts) if part is not None}
        return leaves({**kept, "metrics": self.metrics, "state": self.state})

    def own(self, world: arrdict) -> arrdict:
        """Of an environment's world, the lanes that are stored."""
        return world if self.stored is None else _rows(world, self.stored)

    def for_all(self, actions: Any) -> Any:
        """Actions of the lanes that are stored as actions of all that the environment has, 0 for
        those that act for themselves.
        """
        if self.stored is None:
            return actions
        n = len(self.learners)
        put = mapping(lambda own: own.new_zeros(n, *own.shape[1:]).index_copy(0, self.stored, own))
        return put(actions)

    def store_world(self, t: int, world: arrdict) -> arrdict:
        """Stores the world at time t, and returns it as it was stored, for the policy to act on."""
        self.obs[t] = world["obs"]
        self.starts[t] = world["reset"]
        if "learns" in world:
            self.learns[t] = world["learns"]
        if self.privileged is not None:
            self.privileged[t] = world["privileged"]
        return self.world(t)

    def store_decision(self, t: int, decision: arrdict) -> None:
        """Stores the actions of time t, and their log-probabilities if the policy has any."""
        self.actions[t] = decision["actions"]
        if "logprobs" in decision:
            self.logprobs[t] = decision["logprobs"]

    def store_outcome(self, t: int, world: arrdict) -> None:
        """Stores what the world that followed time t says of the actions of that time."""
        self.reward[t] = world["reward"]
        self.terminal[t], self.truncated[t] = world["terminal"], world["truncated"]
        for name, rows in self.metrics.items():
            rows[t] = world["metrics"][name]

    def world(self, t: int) -> arrdict:
        """What a policy sees at time t: arrdict(obs, reset, and privileged if there is any)."""
        seen = arrdict(obs=self.obs[t], reset=self.starts[t])
        if self.privileged is not None:
            seen["privileged"] = self.privileged[t]
        return seen

    def numbers(self) -> dict[str, torch.Tensor]:
        """All that may stop being finite, by name, each (T, B) or (T+1, B, ...)."""
        named = _floats(self.obs, "obs")
        if self.privileged is not None:
            named |= _floats(self.privileged, "privileged")
        named["reward"] = self.reward
        if self.values is not None:
            named["value"] = self.values
        return named | {"logprob": self.logprobs}

    def transitions(self) -> dict[str, torch.Tensor]:
        """The arguments of `returns.gae`, each (T, B), the last value (B,)."""
        return dict(
            value=self.values[:-1],
            last_value=self.values[-1],
            reward=self.reward,
            reset=self.reset,
            terminal=self.terminal,
            truncated=self.truncated,
        )

    def sequences(self, rows: torch.Tensor) -> arrdict:
        """Whole sequences of some lanes, rows (M,) int64, as a copy: arrdict of

        obs, starts, learns, privileged if there is any   (T+1, M, ...)
        actions, logprobs, reward, terminal, truncated    (T, M, ...)
        state   the policy's before row 0, (M, ...)
        """
        select = mapping(lambda leaf: leaf.index_select(1, rows))
        batch = arrdict({name: select(getattr(self, name)) for name in _SEQUENCES})
        if self.privileged is not None:
            batch["privileged"] = select(self.privileged)
        batch["state"] = _rows(self.state, rows)
        return batch


_SEQUENCES = "obs starts learns actions logprobs reward terminal truncated".split()


def without_last(tree: Any) -> Any:
    """The first T of T+1 rows of a tree of tensors, those that were acted on; None is None."""
    return None if tree is None else mapping(lambda leaf: leaf[:-1])(tree)


def initial_actor_state(env: Any, policy: Any, rollout: Rollout) -> arrdict:
    """Resets an environment, makes room in the rollout for the metrics of its worlds, and returns
    the actor_state that `collect` begins with: arrdict(world, state), of the world what
    `store_world` stores. It shares no memory with the environment.
    """
    first = rollout.own(env.reset())
    rollout.make_room(first)
    world = _stored(first).map(torch.clone)
    return arrdict(world=world, state=policy.initial(len(world.reset)))


def _rows(tree, rows):
    return mapping(lambda leaf: leaf.index_select(0, rows))(tree)


def _stored(world):
    """Of a world, what `store_world` stores."""
    keys = "obs", "reset", "learns", "privileged"
    return arrdict({key: world[key] for key in keys if key in world})


def make_rollout(env: Any, policy: Any, n_steps: int, values: bool = True) -> Rollout:
    """Room for T steps of all lanes of an environment, or of those that learn where others are
    `opponents.Opponents`.
    """
    learners = getattr(env, "learners", None)
    n_lanes = env.n_envs * env.n_agents if learners is None else int(learners.sum())
    return Rollout(
        n_steps,
        n_lanes,
        env.obs_space,
        env.action_space,
        policy.initial(n_lanes),
        env.device,
        policy.privileged_space,
        learners=learners,
        values=values,
    )


def bytes_per_step(env: Any, policy: Any) -> int:
    """About how many bytes a rollout takes per step of one lane: observations, what is privileged,
    and 64 of the rest.
    """
    seen, privileged = (
        sum(math.prod(space.shape) * _itemsize(space, size) for space in leaves(tree or {}))
        for tree, size in ((env.obs_space, 2), (policy.privileged_space, 4))
    )
    return seen + privileged + 64


def _itemsize(space, otherwise):
    """Bytes of one number of a space, `otherwise` where it names no dtype."""
    dtype = getattr(space, "dtype", None)
    return dtype.itemsize if dtype else otherwise


@torch.no_grad()
def collect(env: Any, policy: Any, rollout: Rollout, actor_state: arrdict) -> arrdict:
    """Fills a rollout: T times act, env.step, store. Never synchronises, so it can be a CUDA graph.

    The actor_state (of `initial_actor_state`, or of the `collect` before) is updated in place, and
    returned.
    """
    world, state = actor_state["world"], actor_state["state"]
    rollout.state[:] = state
    features = []
    with policy.compute_dtype():
        for t in range(rollout.n_steps):
            decision, state = policy(rollout.store_world(t, world), state)
            rollout.store_decision(t, decision)
            if rollout.values is not None:
                features.append(decision["features"])
            with torch.autocast(rollout.reward.device.type, enabled=False):
                world = env.step(arrdict(actions=rollout.for_all(decision["actions"])))
                world = rollout.own(world)
            rollout.store_outcome(t, world)

        last = rollout.store_world(rollout.n_steps, world)
        if rollout.values is not None:
            features.append(policy(last, state, sample=False)[0]["features"])
            rollout.values[:] = policy.value(torch.stack(features), rollout.privileged)
    # a memory that is not finite starts anew, or it would last until the lane's episode ends
    state = state.map(lambda leaf: leaf.nan_to_num(0.0, 0.0, 0.0))
    after = arrdict(world=_stored(world), state=state)
    for target, source in zip(leaves(actor_state), leaves(after), strict=True):
        target.copy_(source)
    return actor_state


class Collector:
    """Fills a rollout, again and again, from an environment, which it resets once, unless it is
    given the `actor_state` to go on from. Each call returns the rollout.

    The first time is eager, so that libraries set themselves up; from the second time on a GPU
    replays a CUDA graph, `graph`.
    """

    def __init__(self, env: Any, policy: Any, rollout: Rollout, actor_state: arrdict | None = None):
        self.rollout = rollout
        if actor_state is None:
            actor_state = initial_actor_state(env, policy, rollout)
        self.parts = env, policy, rollout, actor_state
        self.on_gpu = torch.device(env.device).type == "cuda"
        self.n_collected = 0
        self.graph = None

    def __call__(self) -> Rollout:
        if self.on_gpu and self.n_collected == 1:
            self.graph = capture(lambda: collect(*self.parts), (), self.parts)
        self.n_collected += 1
        if self.graph is None:
            collect(*self.parts)
        else:
            self.graph()
        return self.rollout
