"""Collectors: step an environment with a policy and store the transitions in rollouts.

T time, B lanes.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, cast

import torch

from megastep.agents.generator import drawn_ahead
from megastep.agents.storage.copies import copy_all
from megastep.agents.storage.rollout import Rollout, copy_tree
from megastep.agents.types import Actor
from megastep.arrdict import arrdict, clone
from megastep.capture import HostState, capture
from megastep.dotdict import leaves
from megastep.types import Env, Tree, optional

if TYPE_CHECKING:
    from megastep.agents.networks.policy import Policy

_STORED = "obs", "reset", "learns", "privileged", "mask"  # what `Rollout.store_world` reads


def initial_actor_state(env: Env, policy: Actor, rollout: Rollout) -> arrdict:
    """Resets an environment and allocates the rollout's metrics and mask. Returns the actor state
    for `collect`: arrdict(world, state), with a copy of the parts of the current world that
    rollouts store, and the policy's initial hidden state.
    """
    first = rollout.select_lanes(env.reset())
    rollout.allocate_optional(first)
    state = policy.initial(len(first.reset), first.reset.device)
    return arrdict(world=clone(_stored(first)), state=state)


@torch.no_grad()
def collect(env: Env, policy: Actor, rollout: Rollout, actor_state: arrdict) -> arrdict:
    """Fills a rollout: act, step, store, T times. Never synchronises, so CUDA graphs can record it.

    Args:
        env: environment whose current world is in `actor_state`.
        policy: acts; its values are stored if the rollout has `values`.
        rollout: overwritten.
        actor_state: from `initial_actor_state` or the previous `collect`; updated in place, and
            returned.
    """
    world, state = actor_state["world"], actor_state["state"]
    copy_all(zip(leaves(rollout.state), leaves(state), strict=True))
    # A user's code may change actions, also inside an environment that steps on the host: there
    # they are stored before the step, elsewhere with what comes of it.
    is_ours = type(env).__module__.startswith("megastep.envs.") and optional(env, "capturable")
    features = torch.empty(0)
    # on a CPU, a draw of several steps may give other numbers than one each
    n_ahead = rollout.n_steps if rollout.reward.is_cuda else 1
    with policy.compute_dtype(), drawn_ahead(n_ahead):
        seen = rollout.store_world(0, world)
        for t in range(rollout.n_steps):
            with torch.autocast(rollout.reward.device.type, enabled=False):
                optional(env, "begin_step")()
            decision, state = policy(seen, state)
            if not is_ours:
                rollout.store_decision(t, decision)
            others = []
            if rollout.values is not None:
                own = decision["features"]
                features = features if t else own.new_empty(rollout.n_steps + 1, *own.shape)
                others.append((features[t], own))
            with torch.autocast(rollout.reward.device.type, enabled=False):
                world = env.step(arrdict(actions=rollout.scatter_actions(decision["actions"])))
                world = rollout.select_lanes(world)
            layout = None if rollout.layouts is None else optional(env, "layout")
            stored = decision if is_ours else None
            seen = rollout.store_outcome(t, world, layout, stored, others)

        if rollout.values is not None:
            features[-1] = policy(seen, state, sample=False)[0]["features"]
            rollout.values[:] = cast("Policy", policy).value(features, rollout.privileged)
    # A non-finite hidden state would otherwise last until the lane's episode ends.
    state = state.map(lambda leaf: leaf.nan_to_num(0.0, 0.0, 0.0))
    after = arrdict(world=_stored(world), state=state)
    copy_all(zip(leaves(actor_state), leaves(after), strict=True))
    return actor_state


def capture_with(
    env: Env,
    policies: object,
    function: Callable,
    args: tuple = (),
    roots: tuple = (),
    warmup: int = 3,
) -> Callable:
    """Records a function that steps an environment, with a policy or several, as a CUDA graph, by
    `capture`. `roots` are other objects with tensors that the function changes.

    Returns the graph; or the function itself, with a warning, if it cannot be recorded. Attributes
    that are not tensors are restored, so results do not depend on when a graph is recorded.
    """
    state = HostState(env, policies)
    captured = capture(function, args, (env, policies, *roots), warmup, state.changed)
    state.restore()
    return captured


class Collector:
    """Collects T steps per call into one rollout, which is overwritten and returned. Resets the
    environment when it is made.

    The first call runs eagerly, so that libraries are initialised before anything is recorded.
    Later calls on a GPU replay a CUDA graph, unless the environment steps on the host.

    Attributes:
        graph: the CUDA graph, None before the second call and without graphs.
    """

    def __init__(self, env: Env, policy: Actor, rollout: Rollout):
        self.rollout = rollout
        self.parts = env, policy, rollout, initial_actor_state(env, policy, rollout)
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
        """Makes rollouts store the environments' layouts. Call before the first rollout."""
        self.rollout.allocate_layouts()

    def state_dict(self) -> dict[str, Tree]:
        """Returns the actor state, from which the next rollout starts."""
        return {"actor_state": self.parts[-1]}

    def load_state_dict(self, state: dict[str, Tree]) -> None:
        """Restores a `state_dict`, from any device. The next call runs eagerly again."""
        copy_tree(self.parts[-1], state["actor_state"])
        self.n_collected, self.graph = 0, None


def _stored(world) -> arrdict:
    return arrdict({key: world[key] for key in _STORED if key in world})
