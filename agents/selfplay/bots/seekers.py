"""Bots that find the objects of Memory. n lanes, L landmarks per plan, K objects.

They know their pose and walk along shortest paths; they differ in what they know of the objects.
"""

from typing import Any

import torch

from megastep.agents.selfplay.bots.steering import REACH, SteeredBot
from megastep.agents.selfplay.bots.walker import Explorer, Walker
from megastep.arrdict import arrdict

LAST = 1.5  # metres, at most, of the last leg of a way: from a landmark straight to an object
FAR = 100.0  # metres that a longer last leg is worth
NEARBY = 0.5  # metres from a place at which a lane has not left it
PATIENCE, TURNS = 20, 3  # steps at a place after which a lane turns, and for how many


class Oracle(SteeredBot):
    """Knows the maze and where the object to find is. A trained agent beats it in some mazes."""

    block = 2  # squares of 0.3 m per side of a landmark's block: a maze's cell has a landmark

    def __init__(self, env: Any):
        super().__init__(env)
        if not hasattr(env, "cue"):
            raise ValueError(f"it finds the object of env.cue, and {type(env).__name__} has no cue")
        self.cue, self.positions = env.cue, env.objects.all.positions

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the `place` not left, (n, 2) metres, and for how many steps, `stay` (n,)."""
        return arrdict(
            place=torch.zeros(n_lanes, 2, device=device),
            stay=torch.zeros(n_lanes, dtype=torch.int64, device=device),
        )

    def _act(self, world, state, pose, near, generator) -> tuple[arrdict, arrdict]:
        return self._unstuck(self._walk_to(*self._ways(pose, near), pose, near), state, pose)

    def _unstuck(self, decision, state, pose) -> tuple[arrdict, arrdict]:
        """Returns the decision, to turn where a lane does not leave a place, and the next state.

        Where none of the few directions in which it can push brings a lane on, it would stand or
        walk to and fro for ever. Once it has turned, it pushes in others.
        """
        has_left = (pose.position - state["place"]).norm(dim=-1) > NEARBY
        stay = torch.where(has_left, 0, state["stay"] + 1)
        place = torch.where(has_left[:, None], pose.position, state["place"])
        is_stuck = stay % (PATIENCE + TURNS) >= PATIENCE
        turn = arrdict(actions=self.steering.turn.expand_as(decision["actions"]))
        return _chosen(is_stuck, turn, decision), arrdict(state, place=place, stay=stay)

    def _cued(self) -> torch.Tensor:
        """Returns the object to find of each lane, (n, 1) int64."""
        return self.cue[self.steering.lanes].long()[:, None]

    def _ways(self, pose, near) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Returns where objects are, (n, K, 2), the lengths of the shortest ways to them, (n, K)
        metres, and the landmark at which each way turns to its object, (n, K).
        """
        steering, at = self.steering, self.positions[self.steering.lanes]
        landmarks, plans = steering.plans.targets[pose.plan], steering.plans
        last = torch.stack(
            [plans.straight(pose.plan, at[:, k], landmarks) for k in range(at.shape[1])], 1
        )
        last = last + FAR * (last > LAST)
        metres, landmark = (steering.lengths(near)[:, None] + last).min(-1)
        return at, metres, landmark

    def _walk_to(self, at, metres, landmark, pose, near) -> arrdict:
        """Returns the decision that walks to the object to find, from the result of `_ways`."""
        steering, k = self.steering, self._cued()
        goal = at.gather(1, k[..., None].expand(-1, 1, 2))
        aim = steering.aim(pose, near, landmark.gather(1, k)[:, 0])
        is_close = steering.plans.straight(pose.plan, pose.position, goal) < REACH
        aim = torch.where(is_close, goal[:, 0], aim)
        return steering.decide(pose, aim, aim, turning=0.0)

    def _in_view(self, pose, at, metres) -> torch.Tensor:
        """Returns which objects lanes see, (n, K) bool."""
        offsets = at - pose.position[:, None]
        return self._sees(metres, offsets.norm(dim=-1), self.steering.bearings(pose, offsets))


class Mapper(Oracle, Explorer):
    """Does not know the maze or the objects at first: explores frontiers as `Explorer`, remembers
    without error which objects it has seen, and walks to one that it knows by the shortest path.
    """

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns those of an `Oracle` and an `Explorer`, and `known` (n, K) bool."""
        known = torch.zeros(n_lanes, self.positions.shape[1], dtype=torch.bool, device=device)
        state = Oracle.initial(self, n_lanes, device)
        return arrdict(state, **Explorer.initial(self, n_lanes, device), known=known)

    def _act(self, world, state, pose, near, generator) -> tuple[arrdict, arrdict]:
        at, metres, landmark = self._ways(pose, near)
        known = state["known"] & ~world["reset"][:, None] | self._in_view(pose, at, metres)
        to_object = self._walk_to(at, metres, landmark, pose, near)
        to_frontier, explored = Explorer._act(self, world, state, pose, near, generator)
        decision = _chosen(known.gather(1, self._cued()), to_object, to_frontier)
        return self._unstuck(decision, arrdict(state, **explored, known=known), pose)


class Wanderer(Oracle, Walker):
    """Walks between random places as `Walker`, and to the object to find while it sees it. What an
    agent without memory can find.
    """

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the initial states of an `Oracle` and a `Walker`."""
        state = Oracle.initial(self, n_lanes, device)
        return arrdict(state, **SteeredBot.initial(self, n_lanes, device))

    def _act(self, world, state, pose, near, generator) -> tuple[arrdict, arrdict]:
        ways = self._ways(pose, near)
        wandering, walked = Walker._act(self, world, state, pose, near, generator)
        sees = self._in_view(pose, *ways[:2]).gather(1, self._cued())
        decision = _chosen(sees, self._walk_to(*ways, pose, near), wandering)
        return self._unstuck(decision, arrdict(state, **walked), pose)


def _chosen(condition, decision, other) -> arrdict:
    """Returns a decision where the condition, (n,) or (n, 1) bool, is true, elsewhere the other."""
    actions = decision["actions"]
    condition = condition.view(-1, *[1] * (actions.ndim - 1))
    return arrdict(actions=torch.where(condition, actions, other["actions"]))
