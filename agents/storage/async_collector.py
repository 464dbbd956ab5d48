"""Acting ahead of the learner, on weights that are an exact number of updates old.

    call n:    waits for rollout n, hands it over, and has rollout n + lag collected
    rollout n: acted in with the weights after update n - 1 - lag, the first `lag` with the first

On a GPU a stream of its own collects while the learner updates on the current one. On a CPU the
same happens in the same order, one after the other, with the same numbers.
"""

import copy
from collections.abc import Iterator
from itertools import cycle
from typing import Any

import torch

from megastep.agents.storage.rollout import Collector, Rollout, initial_actor_state
from megastep.capture import Graph


class _Slot:
    """Where every `lag`-th rollout is collected: the weights it is acted in with, its memory, its
    graph, and the event of its end.
    """

    def __init__(self, env, policy, rollout, actor_state):
        # autocast keeps the cast of a weight only where it could need a gradient
        self.actor = policy.actor().requires_grad_(True)
        self.actor.random = policy.random  # one random stream for all, which is saved with it
        theirs = policy.state_dict()
        self.own = self.actor.state_dict()
        self.weights = [theirs[name] for name in self.own]
        self.rollout = copy.deepcopy(rollout)
        self.collect = Collector(env, self.actor, self.rollout, actor_state)
        self.end = None

    def take_weights(self):
        torch._foreach_copy_(list(self.own.values()), self.weights)


class AsyncCollector:
    """Collects rollouts of a policy ahead, `lag` of them, and returns one after the other as one
    and the same `rollout`, which stores no values: they would be those of old weights.

    What ran ahead is lost when a run stops: one that goes on begins anew, with the weights of then.
    ValueError if the environment has opponents in it, whose weights change as the learner learns.
    """

    def __init__(self, env: Any, policy: Any, rollout: Rollout, lag: int):
        if rollout.learners is not None:
            raise ValueError(
                f"acting {lag} updates ahead (lag) and opponents cannot be combined, as opponents "
                "change with the updates: give lag=0, or no opponents"
            )
        self.rollout = rollout
        self.on_gpu = torch.device(env.device).type == "cuda"
        self.stream = torch.cuda.Stream(env.device) if self.on_gpu else None
        actor_state = initial_actor_state(env, policy, rollout)
        self.slots = [_Slot(env, policy, rollout, actor_state) for _ in range(lag)]
        self._next: Iterator | None = None

    @property
    def graph(self) -> Any:
        """The graph that collects, once there is one."""
        return self.slots[0].collect.graph

    def __call__(self) -> Rollout:
        if self._next is None:
            self._next = cycle(self.slots)
            for slot in self.slots:
                self._launch(slot)
        slot = next(self._next)
        if self.on_gpu:
            torch.cuda.current_stream(self.rollout.reward.device).wait_event(slot.end)
        self.rollout.copy_(slot.rollout)
        self._launch(slot)
        return self.rollout

    def _launch(self, slot):
        """Has a rollout collected with the weights of now."""
        slot.take_weights()
        if not self.on_gpu:
            slot.collect()
            return
        current = torch.cuda.current_stream(self.stream.device)
        self.stream.wait_stream(current)
        with torch.cuda.stream(self.stream):
            slot.collect()
            slot.end = self.stream.record_event()
        if not isinstance(slot.collect.graph, Graph):
            # An environment may replace tensors in its first steps, which frees memory of the
            # current stream: it must not be used again before those steps are done.
            current.wait_event(slot.end)

    def wait(self) -> None:
        """Waits until nothing is being collected: the environment may be looked at, or go."""
        if self.on_gpu:
            self.stream.synchronize()
