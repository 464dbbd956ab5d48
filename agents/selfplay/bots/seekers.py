"""Bots that find the objects of Memory. n lanes, L landmarks per plan, K objects.

They know their pose and walk along shortest paths; they differ in what they know of the objects.
"""

import copy
from collections.abc import Mapping
from typing import Any

import torch

from megastep.agents.selfplay.bots.explorer import BENT, SIGHT, Explorer
from megastep.agents.selfplay.bots.steering import REACH, Pose, Steering
from megastep.agents.selfplay.bots.walker import Walker
from megastep.arrdict import arrdict

BLOCK = 2  # squares of 0.3 m per side of a landmark's block: a maze's cell has a landmark
LAST = 1.5  # metres, at most, of the last leg of a way: from a landmark straight to an object
FAR = 100.0  # metres that a longer last leg is worth
NEARBY = 0.5  # metres from a place at which a lane has not left it
PATIENCE, TURNS = 20, 3  # steps at a place after which a lane turns, and for how many


class Oracle:
    """Knows the maze and where the object to find is. The most that an agent can find.

    Args:
        env: a Memory.
        otherwise: class of the bot that decides while it does not know where the object is.
    """

    def __init__(self, env: Any, otherwise: Any = None):
        self.steering = Steering(env, block=BLOCK)
        self.otherwise: Any = None if otherwise is None else otherwise(env, self.steering)
        if not hasattr(env, "cue"):
            raise ValueError(f"it finds the object of env.cue, and {type(env).__name__} has no cue")
        self.cue, self.positions = env.cue, env.objects.all.positions

    def in_lanes(self, lanes: torch.Tensor) -> "Oracle":
        """Returns one that plays in lanes (n,) int64 of the environment."""
        seeker = copy.copy(self)
        seeker.steering = self.steering.in_lanes(lanes)
        if self.otherwise is not None:
            seeker.otherwise = copy.copy(self.otherwise)
            seeker.otherwise.steering = seeker.steering
        return seeker

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the initial state: the `place` that it has not left, (n, 2) metres, and
        for how many steps, `stay` (n,) int64.
        """
        return arrdict(
            place=torch.zeros(n_lanes, 2, device=device),
            stay=torch.zeros(n_lanes, dtype=torch.int64, device=device),
        )

    def __call__(
        self,
        world: Mapping,
        state: Mapping,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, arrdict]:
        """Returns (arrdict(actions (n, 1)), next state)."""
        pose = self.steering.pose()
        near = self.steering.near(pose)
        decision = self.walk_to(self.cued(), *self.ways(pose, near), pose, near)
        return self.unstick(decision, state, pose)

    def unstick(self, decision: arrdict, state: Mapping, pose: Pose) -> tuple[arrdict, arrdict]:
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

    def cued(self) -> torch.Tensor:
        """Returns the object to find of each lane, (n,) int64."""
        return self.cue[self.steering.lanes].long()

    def ways(self, pose: Pose, near: tuple) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
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

    def walk_to(
        self,
        k: torch.Tensor,
        at: torch.Tensor,
        metres: torch.Tensor,
        landmark: torch.Tensor,
        pose: Pose,
        near: tuple,
    ) -> arrdict:
        """Returns the decision that walks to object k (n,) of each lane."""
        steering, k = self.steering, k[:, None]
        goal = at.gather(1, k[..., None].expand(-1, 1, 2))
        aim = steering.aim(pose, near, landmark.gather(1, k)[:, 0])
        is_close = steering.plans.straight(pose.plan, pose.position, goal) < REACH
        aim = torch.where(is_close, goal[:, 0], aim)
        return steering.decide(pose, aim, aim, turning=0.0)

    def in_view(self, pose: Pose, at: torch.Tensor, metres: torch.Tensor) -> torch.Tensor:
        """Returns which objects lanes see, (n, K) bool: those to which the way is straight."""
        offsets = at - pose.position[:, None]
        away = offsets.norm(dim=-1)
        is_straight = (metres < BENT[0] * away + BENT[1]) & (away < SIGHT)
        return is_straight & self.steering.are_in_view(self.steering.bearings(pose, offsets))


class Mapper(Oracle):
    """Does not know the maze or the objects at first: explores frontiers as `Explorer`, remembers
    without error which objects it has seen, and walks to one that it knows by the shortest path.

    What perfect memory can find.
    """

    def __init__(self, env: Any):
        super().__init__(env, Explorer)

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the initial state: those of an `Oracle` and an `Explorer`, and `known` (n, K)
        bool.
        """
        known = torch.zeros(n_lanes, self.positions.shape[1], dtype=torch.bool, device=device)
        state = super().initial(n_lanes, device)
        return arrdict(state, **self.otherwise.initial(n_lanes, device), known=known)

    def __call__(
        self,
        world: Mapping,
        state: Mapping,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, arrdict]:
        """Returns (arrdict(actions (n, 1)), next state)."""
        pose, k = self.steering.pose(), self.cued()
        near = self.steering.near(pose)
        at, metres, landmark = self.ways(pose, near)
        known = state["known"] & ~world["reset"][:, None] | self.in_view(pose, at, metres)
        explored = self.otherwise.explore(world["reset"], state, pose, near)
        to_object = self.walk_to(k, at, metres, landmark, pose, near)
        aim = self.steering.aim(pose, near, explored["target"])
        to_frontier = self.steering.decide(pose, aim, aim)
        decision = _chosen(known.gather(1, k[:, None]), to_object, to_frontier)
        return self.unstick(decision, arrdict(state, **explored, known=known), pose)


class Wanderer(Oracle):
    """Walks between random places as `Walker`, and to the object to find while it sees it. What an
    agent without memory can find.
    """

    def __init__(self, env: Any):
        super().__init__(env, Walker)

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the initial state: those of an `Oracle` and a `Walker`."""
        return arrdict(super().initial(n_lanes, device), **self.otherwise.initial(n_lanes, device))

    def __call__(
        self,
        world: Mapping,
        state: Mapping,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, arrdict]:
        """Returns (arrdict(actions (n, 1)), next state)."""
        pose, k = self.steering.pose(), self.cued()
        near = self.steering.near(pose)
        ways = self.ways(pose, near)
        to_object = self.walk_to(k, *ways, pose, near)
        wandering, walked = self.otherwise(world, state, sample, generator)
        sees = self.in_view(pose, *ways[:2]).gather(1, k[:, None])
        decision = _chosen(sees, to_object, wandering)
        return self.unstick(decision, arrdict(state, **walked), pose)


def _chosen(condition, decision, other) -> arrdict:
    """Returns a decision where the condition, (n,) or (n, 1) bool, is true, elsewhere the other."""
    actions = decision["actions"]
    condition = condition.view(-1, *[1] * (actions.ndim - 1))
    return arrdict(actions=torch.where(condition, actions, other["actions"]))
