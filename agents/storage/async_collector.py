"""Collects rollouts while the learner updates, with weights that are exactly `lag` updates old.

    call n:    waits for rollout n, returns it, and starts collecting rollout n + lag
    rollout n: collected with the weights after update n - 1 - lag, or the initial weights

On a GPU, a second stream collects while the learner updates on the current stream. On a CPU the two
take turns, in the same order.
"""

import copy
from collections.abc import Callable

import torch

from megastep.agents.networks.policy import Policy
from megastep.agents.storage.collector import Collector, initial_actor_state
from megastep.agents.storage.rollout import Rollout, copy_tree
from megastep.agents.types import StateDict
from megastep.arrdict import arrdict
from megastep.capture import Graph
from megastep.types import Env


class _Slot:
    """One of the `lag` rollouts in progress, with its weights, CUDA graph and end event."""

    def __init__(self, env: Env, policy: Policy, rollout: Rollout, actor_state: arrdict):
        # autocast caches casts only of weights that require a gradient
        self.actor = policy.actor().requires_grad_(True)
        self.actor.generator = policy.generator  # shared by all actors and saved with the policy
        policy_weights = policy.state_dict()
        self.weights = self.actor.state_dict()
        self.sources = [policy_weights[name] for name in self.weights]
        self.rollout = copy.deepcopy(rollout)
        self.collect = Collector(env, self.actor, self.rollout, actor_state)
        self.end = None

    def copy_weights(self) -> None:
        torch._foreach_copy_([*self.weights.values()], self.sources)  # pyright: ignore[reportPrivateImportUsage]


class AsyncCollector:
    """Collects `lag` rollouts in advance. Each call copies the next one into `rollout`, which has
    no values, returns it, and starts another. ValueError if the environment has opponents.
    """

    def __init__(self, env: Env, policy: Policy, rollout: Rollout, lag: int):
        if rollout.learners is not None:
            raise ValueError(
                f"lag={lag} does not work with opponents, whose weights change with the updates: "
                "use lag=0 or no opponents"
            )
        self.rollout = rollout
        self.on_gpu = torch.device(env.device).type == "cuda"
        self.stream = torch.cuda.Stream(env.device) if self.on_gpu else None
        actor_state = initial_actor_state(env, policy, rollout)
        self.slots = [_Slot(env, policy, rollout, actor_state) for _ in range(lag)]
        self.actor_state = actor_state
        self.n_returned = 0  # rollouts; slot n_returned % lag holds the next one
        self.is_ahead = False  # True once every slot is collecting

    @property
    def graph(self) -> Callable | None:
        """The CUDA graph that collects; None before the second rollout and without graphs."""
        return self.slots[0].collect.graph

    def __call__(self) -> Rollout:
        if not self.is_ahead:
            self.is_ahead = True
            for slot in self.slots:
                self._launch(slot)
        slot = self.slots[self.n_returned % len(self.slots)]
        self.n_returned += 1
        if slot.end is not None:
            torch.cuda.current_stream(self.rollout.reward.device).wait_event(slot.end)
        self.rollout.load_state_dict(slot.rollout.state_dict())
        self._launch(slot)
        return self.rollout

    def allocate_layouts(self) -> None:
        """Makes rollouts store the environments' layouts. Call before the first rollout."""
        for rollout in (self.rollout, *(slot.rollout for slot in self.slots)):
            rollout.allocate_layouts()

    def _launch(self, slot) -> None:
        """Starts collecting a rollout with the policy's current weights."""
        slot.copy_weights()
        if self.stream is None:
            slot.collect()
            return
        current = torch.cuda.current_stream(self.stream.device)
        self.stream.wait_stream(current)
        with torch.cuda.stream(self.stream):
            slot.collect()
            slot.end = self.stream.record_event()
        if not isinstance(slot.collect.graph, Graph):
            # An eager environment may free memory that was allocated on the current stream, which
            # must not reuse it before these steps are done.
            current.wait_event(slot.end)

    def wait(self) -> None:
        """Blocks until no rollout is being collected. Call it before using the environment."""
        if self.stream is not None:
            self.stream.synchronize()

    def state_dict(self) -> StateDict:
        """Returns the actor state and the rollouts collected in advance. Call `wait` first."""
        rollouts = [slot.rollout.state_dict() for slot in self.slots] if self.is_ahead else []
        return dict(actor_state=self.actor_state, rollouts=rollouts, n_returned=self.n_returned)

    def load_state_dict(self, state: StateDict) -> None:
        """Restores a `state_dict` of a collector with the same lag."""
        copy_tree(self.actor_state, state["actor_state"])
        self.n_returned, self.is_ahead = state["n_returned"], bool(state["rollouts"])
        for slot, rollout in zip(self.slots, state["rollouts"]):
            slot.rollout.load_state_dict(rollout)
