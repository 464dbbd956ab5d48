"""Collectors: a policy acts in an environment and fills rollouts.

T time, B lanes.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, cast

import torch

from megastep.agents.storage.rollout import Rollout, copy_tree
from megastep.agents.types import Actor
from megastep.arrdict import arrdict
from megastep.capture import capture
from megastep.dotdict import leaves
from megastep.env_state import EnvState
from megastep.types import Env, Tree, optional

if TYPE_CHECKING:
    from megastep.agents.networks.policy import Policy

_STORED = "obs", "reset", "learns", "privileged"  # what `Rollout.store_world` reads


def initial_actor_state(env: Env, policy: Actor, rollout: Rollout) -> arrdict:
    """Resets an environment and allocates the rollout's metrics.

    Returns the actor state for `collect`: arrdict(world, state), a copy of the parts of the current
    world that rollouts store, and the hidden state.
    """
    first = rollout.select_lanes(env.reset())
    rollout.allocate_metrics(first)
    world = _stored(first).map(torch.clone)
    return arrdict(world=world, state=policy.initial(len(world.reset)))


@torch.no_grad()
def collect(env: Env, policy: Actor, rollout: Rollout, actor_state: arrdict) -> arrdict:
    """Fills a rollout: T times act, step, store. Never synchronises, so it can be captured.

    Args:
        actor_state: of `initial_actor_state` or of the previous `collect`; updated in place.

    Returns:
        the actor state.
    """
    world, state = actor_state["world"], actor_state["state"]
    rollout.state[:] = state
    features = []
    with policy.compute_dtype():
        seen = rollout.store_world(0, world)
        for t in range(rollout.n_steps):
            with torch.autocast(rollout.reward.device.type, enabled=False):
                optional(env, "begin_step")()
            decision, state = policy(seen, state)
            rollout.store_decision(t, decision)
            if rollout.values is not None:
                features.append(decision["features"])
            with torch.autocast(rollout.reward.device.type, enabled=False):
                world = env.step(arrdict(actions=rollout.scatter_actions(decision["actions"])))
                world = rollout.select_lanes(world)
            layout = None if rollout.layouts is None else optional(env, "layout")
            seen = rollout.store_outcome(t, world, layout)

        if rollout.values is not None:
            features.append(policy(seen, state, sample=False)[0]["features"])
            values = cast("Policy", policy).value(torch.stack(features), rollout.privileged)
            rollout.values[:] = values
    # Clear a non-finite hidden state, which would otherwise last until the lane's episode ends.
    state = state.map(lambda leaf: leaf.nan_to_num(0.0, 0.0, 0.0))
    after = arrdict(world=_stored(world), state=state)
    for target, source in zip(leaves(actor_state), leaves(after), strict=True):
        target.copy_(source)
    return actor_state


def capture_with(
    env: Env,
    policies: object,
    function: Callable,
    args: tuple = (),
    roots: tuple = (),
    warmup: int = 3,
) -> Callable:
    """Records a function that acts in an environment as a CUDA graph, see
    `megastep.capture.capture`. If it changes what an environment or a policy of another's class
    keeps besides tensors, it is returned as it is, with the warning of `capture`. Such values stay
    as they were, so nothing depends on when a graph is recorded.

    Args:
        env: the environment.
        policies: a policy, or several in a tuple.
        function, args, warmup: as in `capture`.
        roots: what else the function changes.
    """
    state = EnvState(env, policies, host_only=True)
    before = state.host_state()
    roots = env, policies, *roots
    captured = capture(function, args, roots, warmup, lambda: state.changed_on_host(before))
    state.restore_host(before)
    return captured


class Collector:
    """Fills the same rollout again and again. Each call collects T steps and returns the rollout.

    The first call is eager, so that libraries can initialise themselves. From the second call on, a
    GPU replays a CUDA graph, unless the environment steps on the host.

    Args:
        env: environment. It is reset here, once, unless there is an `actor_state`.
        policy: the acting policy.
        rollout: the rollout to fill.
        actor_state: actor state to continue from; None resets the environment.

    Attributes:
        graph: the captured graph, or None.
    """

    def __init__(
        self, env: Env, policy: Actor, rollout: Rollout, actor_state: arrdict | None = None
    ):
        self.rollout = rollout
        if actor_state is None:
            actor_state = initial_actor_state(env, policy, rollout)
        self.parts = env, policy, rollout, actor_state
        on_gpu = torch.device(env.device).type == "cuda"
        self.can_capture = on_gpu and optional(env, "capturable")
        self.n_collected = 0
        self.graph = None

    def __call__(self) -> Rollout:
        if self.can_capture and self.n_collected == 1:
            env, policy, *others = self.parts
            self.graph = capture_with(env, policy, lambda: collect(*self.parts), roots=(*others,))
        self.n_collected += 1
        if self.graph is None:
            collect(*self.parts)
        else:
            self.graph()
        return self.rollout

    def allocate_layouts(self) -> None:
        """Has rollouts hold the environment's layouts. Call before the first rollout."""
        self.rollout.allocate_layouts()

    def state_dict(self) -> dict[str, Tree]:
        """Returns the actor state: what the next rollout starts from, besides the environment."""
        return {"actor_state": self.parts[-1]}

    def load_state_dict(self, state: dict[str, Tree]) -> None:
        """Continues from a `state_dict`, which may come from another device. The next call is eager
        again.
        """
        copy_tree(self.parts[-1], state["actor_state"])
        self.n_collected, self.graph = 0, None


def _stored(world) -> arrdict:
    return arrdict({key: world[key] for key in _STORED if key in world})
