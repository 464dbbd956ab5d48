"""A bot that explores homes. n lanes, L landmarks per plan."""

import copy
from collections.abc import Mapping
from typing import Any

import torch

from megastep.agents.selfplay.bots.steering import Pose, Steering
from megastep.arrdict import arrdict

SIGHT, NEAR = 10.0, 0.4  # metres to which a landmark is in view, and seen without looking
BENT = 1.05, 0.2  # a way this many times as long as straight, and metres more, is in view
AROUND = 0.01  # metres that a degree away from the heading is worth in choosing where to go
PATIENCE, PER_METRE = 15, 15  # steps after which it gives up a target, and more per metre


class Explorer:
    """Explores by frontiers (Yamauchi, "A frontier-based approach for autonomous exploration",
    1997): goes to the nearest floor that it has not seen in the episode, over floor that it has.

    It knows its pose, and how long the way over floor is that it has seen. Once everything is seen,
    it begins anew. It sees floor to which the way is straight, in its field of view.

    Args:
        env: the environment that it plays in.
        steering: how it walks there. Default: by landmarks that are 1.2 m apart.
    """

    def __init__(self, env: Any, steering: Steering | None = None):
        self.steering = steering or Steering(env)

    def in_lanes(self, lanes: torch.Tensor) -> "Explorer":
        """Returns one that plays in lanes (n,) int64 of the environment."""
        explorer = copy.copy(self)
        explorer.steering = self.steering.in_lanes(lanes)
        return explorer

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the initial state: landmarks `seen` (n, L) bool, and (n,) int64 each, the
        `target` and steps of `patience` with it.
        """
        target, patience = torch.zeros(2, n_lanes, dtype=torch.int64, device=device).unbind()
        n_landmarks = self.steering.plans.targets.shape[1]
        seen = torch.zeros(n_lanes, n_landmarks, dtype=torch.bool, device=device)
        return arrdict(seen=seen, target=target, patience=patience)

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
        state = self.explore(world["reset"], state, pose, near)
        aim = self.steering.aim(pose, near, state["target"])
        return self.steering.decide(pose, aim, aim), state

    def explore(self, reset: torch.Tensor, state: Mapping, pose: Pose, near: tuple) -> arrdict:
        """Returns the next state, with where to go."""
        plans, lengths = self.steering.plans, self.steering.lengths(near)
        offsets = plans.targets[pose.plan] - pose.position[:, None]
        away = offsets.norm(dim=-1)
        bearing = self.steering.bearings(pose, offsets)
        in_view = (lengths < BENT[0] * away + BENT[1]) & (away < SIGHT)
        in_view &= self.steering.are_in_view(bearing)
        seen = (state["seen"] & ~reset[:, None]) | in_view | (away < NEAR)
        target, patience = state["target"][:, None], state["patience"] - 1
        seen = seen.scatter(1, target, seen.gather(1, target) | (patience <= 0)[:, None])
        reached = lengths.isfinite()
        seen &= (reached & ~seen).any(1, True)  # when all is seen, it forgets
        is_over = reset | seen.gather(1, target)[:, 0]
        costs = torch.where(reached & ~seen, lengths + AROUND * bearing.abs(), torch.inf)
        nearest = costs.argmin(1)
        steps = PATIENCE + PER_METRE * lengths.gather(1, nearest[:, None])[:, 0].clamp(max=1e3)
        return arrdict(
            seen=seen,
            target=torch.where(is_over, nearest, target[:, 0]),
            patience=torch.where(is_over, steps.long(), patience),
        )
