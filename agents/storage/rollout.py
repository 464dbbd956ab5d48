"""Rollouts: T steps of B lanes on the device.

T time, B lanes, M lanes of a minibatch. Row t of a rollout has the observation and the action of
time t. `reward`, `reset`, `terminal` and `truncated` in row t come from the next world, t+1. So row
t is a valid transition unless its `reset` is set.
"""

import math
from collections.abc import Mapping, Sequence

import torch
from torch.utils._pytree import tree_flatten, tree_unflatten

from megastep import spaces
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.copies import copy_all, select_lanes, select_tree
from megastep.arrdict import arrdict, clone
from megastep.dotdict import mapping
from megastep.types import Env, Space, Tree, n_lanes, optional

#: Parts of a rollout that `Rollout.sequences` selects from.
SEQUENCES = "obs starts learns actions logprobs reward terminal truncated privileged mask".split()
Pairs = list[tuple[torch.Tensor, torch.Tensor]]  # (target, source)
_BYTES_OF_THE_REST = 64  # of a step: everything except observations


class Rollout:
    """T steps of B lanes. Memory is allocated once and overwritten by every `collect`.

    Args:
        n_steps: T.
        n_lanes: B.
        obs_space, action_space: the environment's.
        state: the policy's hidden state of B lanes, such as `policy.initial(B)`; copied.
        device: device of all tensors.
        privileged_space: space of privileged observations, which only the critic sees, or None.
        learners: bool per lane of the environment, true for the B lanes to store, in environments
            with opponents; None stores every lane.
        values: whether to store the critic's values.

    Attributes:
        obs: (T+1, B, ...), float16 unless integers or the space names a dtype. The last row is the
            observation that the next rollout starts from.
        privileged: (T+1, B, ...) float32, or None without a `privileged_space`.
        mask: (T+1, B, A, n) bool per discrete action space, allowed actions, or None if worlds have
            none.
        starts: (T+1, B) bool, whether the observation is its episode's first.
        learns: (T+1, B) bool, whether to learn from the lane at that time. True unless worlds
            have `learns`.
        actions: (T, B, ...) int64, or float32 if continuous.
        logprobs: (T, B), log-probabilities of the actions under the policy that took them; 0 for a
            policy that gives none.
        values: (T+1, B), the critic's values at the time of acting, or None.
        reward: (T, B).
        terminal: (T, B) bool.
        truncated: (T, B) bool.
        metrics: (T, B) float32 by name, read where an episode ends.
        layouts: (T, B) int32, the floor plan that the action led through, for a curriculum and for
            statistics by source; None without `allocate_layouts`.
        state: (B, ...), the policy's hidden state before row 0.
    """

    def __init__(
        self,
        n_steps: int,
        n_lanes: int,
        obs_space: Space,
        action_space: Space,
        state: arrdict,
        device: torch.device | str | None = None,
        privileged_space: Space | None = None,
        learners: torch.Tensor | None = None,
        values: bool = True,
    ):
        self.n_steps, self.n_lanes, self.learners = n_steps, n_lanes, learners
        self.lane_indices = None if learners is None else learners.nonzero()[:, 0]
        rows, with_last = (n_steps, n_lanes), (n_steps + 1, n_lanes)
        self.obs = _zeros(obs_space, with_last, device, torch.float16)
        self.privileged = None
        if privileged_space is not None:
            self.privileged = _zeros(privileged_space, with_last, device)
        self.actions = _zeros(action_space, rows, device)
        flags: dict = dict(dtype=torch.bool, device=device)
        self.starts, self.learns = torch.zeros(with_last, **flags), torch.ones(with_last, **flags)
        self.terminal, self.truncated = (torch.zeros(rows, **flags) for _ in range(2))
        self.values = torch.zeros(with_last, device=device) if values else None
        self.logprobs, self.reward = (torch.zeros(rows, device=device) for _ in range(2))
        self.metrics = arrdict()
        self.mask: Tree = None
        self.layouts: torch.Tensor | None = None
        self.state = clone(state)

    # ---- Writing ----

    def allocate_optional(self, world: arrdict) -> None:
        """Allocates the metrics and the mask that this world has. Call it before the first step."""
        if "mask" in world:
            rows = self.n_steps + 1
            self.mask = mapping(lambda leaf: leaf.new_ones(rows, *leaf.shape))(world["mask"])
        for name in world.get("metrics", {}):
            self.metrics[name] = torch.zeros_like(self.reward)

    def allocate_layouts(self) -> None:
        """Makes the rollout store the environments' layouts. Call before the first step."""
        if self.layouts is None:
            self.layouts = torch.zeros_like(self.reward, dtype=torch.int32)

    def store_world(self, t: int, world: arrdict) -> arrdict:
        """Stores the world at time t. Returns the stored copy, on which the policy acts."""
        copy_all(self._of_world(t, world))
        return self.world(t)

    def store_decision(self, t: int, decision: Mapping) -> None:
        """Stores the actions of time t, and log-probabilities if the decision has them. Call it
        before the environment steps, which may change actions in place.
        """
        copy_all(self._of_decision(t, decision))

    def store_outcome(
        self,
        t: int,
        world: arrdict,
        layout: torch.Tensor | None = None,
        decision: Mapping | None = None,
        others: Sequence[tuple[torch.Tensor, torch.Tensor]] = (),
    ) -> arrdict:
        """Stores the world after the action of time t: reward, episode end, metrics in row t, the
        observation in row t + 1. Returns `world(t + 1)`, the stored observation.

        Args:
            layout: (N,) integers, the environments' layouts in that world, if they are stored.
            decision: is stored with it, as `store_decision` does.
            others: further pairs of a target and what is copied into it.
        """
        names = "reward", "terminal", "truncated"
        pairs = [(getattr(self, name)[t], world[name]) for name in names]
        pairs += [(rows[t], world["metrics"][name]) for name, rows in self.metrics.items()]
        pairs += [*others, *self._of_world(t + 1, world)]
        pairs += [] if decision is None else self._of_decision(t, decision)
        if layout is not None:
            n_env_lanes = self.n_lanes if self.learners is None else len(self.learners)
            by_lane = layout[:, None].expand(-1, n_env_lanes // len(layout)).flatten()
            assert self.layouts is not None
            pairs.append((self.layouts[t], self.select_lanes(by_lane)))
        copy_all(pairs)
        return self.world(t + 1)

    def _of_decision(self, t, decision) -> Pairs:
        pairs = _pairs(self.actions, t, decision["actions"])
        if "logprobs" in decision:
            pairs.append((self.logprobs[t], decision["logprobs"]))
        return pairs

    def _of_world(self, t, world) -> Pairs:
        rows = self._seen()
        if "learns" in world:
            rows["learns"] = self.learns
        return [pair for name, leaf in rows.items() for pair in _pairs(leaf, t, world[name])]

    def _seen(self) -> dict[str, Tree]:
        """Returns what policies and critics see of a world, at all times."""
        rows = dict(obs=self.obs, reset=self.starts, privileged=self.privileged, mask=self.mask)
        return {name: leaf for name, leaf in rows.items() if leaf is not None}

    # ---- Lanes of the environment and lanes of the rollout ----

    def select_lanes(self, world: Tree) -> Tree:
        """Returns the stored lanes of an environment's world, or of a tensor (B, ...)."""
        return world if self.lane_indices is None else select_tree(world, self.lane_indices)

    def scatter_actions(self, actions: Tree) -> Tree:
        """Returns actions for every lane of the environment: 0 for lanes that are not stored."""
        if self.lane_indices is None or self.learners is None:
            return actions
        n_env_lanes = len(self.learners)

        @mapping
        def scatter(leaf) -> torch.Tensor:
            zeros = leaf.new_zeros(n_env_lanes, *leaf.shape[1:])
            return zeros.index_copy(0, self.lane_indices, leaf)

        return scatter(actions)

    # ---- Reading ----

    @property
    def reset(self) -> torch.Tensor:
        """(T, B) bool, true where the action was ignored because an episode started."""
        return self.starts[1:]

    def world(self, t: int) -> arrdict:
        """Returns the policy's input at time t: arrdict(obs, reset), and privileged and mask if
        stored.
        """
        return arrdict(self._seen())[t]

    def floats(self) -> dict[str, torch.Tensor]:
        """Returns every tensor that may become non-finite, by name: (T, B) or (T+1, B, ...)."""
        tensors = spaces.leaves(self.obs, "obs") | spaces.leaves(self.actions, "actions")
        if self.privileged is not None:
            tensors |= spaces.leaves(self.privileged, "privileged")
        tensors = {name: leaf for name, leaf in tensors.items() if leaf.is_floating_point()}
        tensors["reward"] = self.reward
        if self.values is not None:
            tensors["value"] = self.values
        return tensors | {"logprob": self.logprobs}

    def transitions(self) -> dict[str, torch.Tensor]:
        """Returns the arguments of `returns.gae`: (T, B) each, and the last value (B,)."""
        assert self.values is not None
        return dict(
            value=self.values[:-1],
            last_value=self.values[-1],
            reward=self.reward,
            reset=self.starts[1:],
            terminal=self.terminal,
            truncated=self.truncated,
        )

    def sequences(
        self,
        lanes: torch.Tensor,
        names: Sequence[str] = SEQUENCES,
        others: Mapping[str, torch.Tensor] = arrdict(),
    ) -> arrdict:
        """Returns whole sequences of some lanes, as a copy.

        Args:
            lanes: (M,) int64.
            names: which of the parts to return, besides `state`.
            others: further tensors (T, B, ...) to return, by name.

        Returns:
            arrdict of obs, starts, learns, privileged and mask (if stored), (T+1, M, ...); actions,
            logprobs, reward, terminal and truncated, each (T, M, ...); `others`; and state
            (M, ...), the hidden state before row 0.
        """
        parts = arrdict({name: getattr(self, name) for name in names})
        parts = arrdict({name: part for name, part in parts.items() if part is not None}, **others)
        parts["state"] = self.state[None]  # as one step
        leaves, spec = tree_flatten(parts)
        batch = tree_unflatten(select_lanes(leaves, lanes), spec)
        batch["state"] = batch["state"][0]
        return batch


def make_rollout(env: Env, policy: Policy, n_steps: int, values: bool = True) -> Rollout:
    """Allocates a rollout of T steps of all lanes of an environment, or of those that learn if it
    has `learners` (opponents).
    """
    learners = optional(env, "learners")
    n_stored = n_lanes(env) if learners is None else int(learners.sum())
    return Rollout(
        n_steps,
        n_stored,
        env.obs_space,
        env.action_space,
        policy.initial(n_stored),
        env.device,
        policy.privileged_space,
        learners=learners,
        values=values,
    )


def bytes_per_step(env: Env, policy: Policy) -> int:
    """Returns the approximate size of a rollout in bytes per step and lane."""
    n_bytes = _BYTES_OF_THE_REST
    for space, itemsize in (env.obs_space, 2), (policy.privileged_space or {}, 4):
        for leaf in spaces.leaves(space).values():
            dtype = getattr(leaf, "dtype", None)
            n_bytes += math.prod(leaf.shape) * (dtype.itemsize if dtype else itemsize)
    return n_bytes


def copy_tree(target: Tree, source: Tree) -> None:
    """Copies the tensors of a tree into those of another with the same keys, on any device."""
    spaces.map(torch.Tensor.copy_, target, source)


def without_last(tree: Tree) -> Tree:
    """Returns the first T of T+1 rows, those with actions, of a tree of tensors or of None."""
    return None if tree is None else tree[:-1]


def _pairs(rows, t, tree) -> Pairs:
    targets, sources = spaces.leaves(rows), spaces.leaves(tree)
    return [(target[t], sources[path]) for path, target in targets.items()]


def _zeros(space, lead, device, dtype=torch.float32) -> Tree:
    """Returns zeros (*lead, ...) for a space: int64 for integers, else the dtype that the space
    names, else `dtype`.
    """

    def zeros(leaf) -> torch.Tensor:
        is_integer = isinstance(leaf, spaces.MultiDiscrete)
        leaf_dtype = torch.int64 if is_integer else getattr(leaf, "dtype", None) or dtype
        return torch.zeros(*lead, *leaf.shape, dtype=leaf_dtype, device=device)

    return spaces.map(zeros, space)
