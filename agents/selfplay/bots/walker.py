"""Bots that walk along shortest paths, and that explore. N environments, n lanes, L landmarks per
plan.
"""

from typing import Any

import torch

from megastep.agents.selfplay.bots.steering import SteeredBot, Steering
from megastep.arrdict import arrdict

ARRIVED = 0.3  # metres
PATIENCE, PER_METRE = 20, 20  # steps after which it gives up a target, and more per metre
NEAR = 0.4  # metres to which a landmark is seen without looking
AROUND = 0.01  # metres that a degree away from the heading is worth in choosing where to go
EXPLORER_PATIENCE = 15  # PATIENCE and PER_METRE of an Explorer


class Walker(SteeredBot):
    """Walks along shortest paths: to the goals of PointGoal, elsewhere to one landmark after the
    other, drawn at random. It knows the floor plans, its pose and the goals.
    """

    goal_index = None

    def __init__(self, env: Any):
        if hasattr(env, "goal_index"):
            self.goal_index, self.steering = env.goal_index, Steering(env, env.goals.points)
        else:
            super().__init__(env)

    def _act(self, world, state, pose, near, generator) -> tuple[arrdict, arrdict]:
        steering, patience, target = self.steering, state["patience"] - 1, state["target"]
        if self.goal_index is not None:
            target = self.goal_index[steering.lanes].long()
        else:
            goal = steering.plans.targets[pose.plan, target]
            is_over = (goal - pose.position).norm(dim=-1) < ARRIVED
            is_over |= world["reset"] | (patience <= 0)
            lengths = steering.lengths(near)
            draws = torch.rand(lengths.shape, generator=generator, device=target.device)
            drawn = (draws * lengths.isfinite()).argmax(1)
            steps = PATIENCE + PER_METRE * lengths.gather(1, drawn[:, None])[:, 0].clamp(max=1e3)
            target = torch.where(is_over, drawn, target)
            patience = torch.where(is_over, steps.long(), patience)
        aim = steering.aim(pose, near, target)
        decision = steering.decide(pose, aim, aim, turning=0.0)
        return decision, arrdict(target=target, patience=patience)


class Explorer(SteeredBot):
    """Explores by frontiers (Yamauchi, "A frontier-based approach for autonomous exploration",
    1997): goes to the nearest floor that it has not seen in the episode, over floor that it has.

    It knows its pose, and how long the way over floor is that it has seen. Once everything is seen,
    it begins anew. It sees floor to which the way is straight, in its field of view.
    """

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns that of any bot, and landmarks `seen` (n, L) bool."""
        n_landmarks = self.steering.plans.targets.shape[1]
        seen = torch.zeros(n_lanes, n_landmarks, dtype=torch.bool, device=device)
        return arrdict(seen=seen, **super().initial(n_lanes, device))

    def _act(self, world, state, pose, near, generator) -> tuple[arrdict, arrdict]:
        state = self._explore(world["reset"], state, pose, near)
        aim = self.steering.aim(pose, near, state["target"])
        return self.steering.decide(pose, aim, aim), state

    def _explore(self, reset, state, pose, near) -> arrdict:
        """Returns the next state, with where to go."""
        plans, lengths = self.steering.plans, self.steering.lengths(near)
        offsets = plans.targets[pose.plan] - pose.position[:, None]
        away = offsets.norm(dim=-1)
        bearing = self.steering.bearings(pose, offsets)
        seen = (
            (state["seen"] & ~reset[:, None]) | self._sees(lengths, away, bearing) | (away < NEAR)
        )
        target, patience = state["target"][:, None], state["patience"] - 1
        seen = seen.scatter(1, target, seen.gather(1, target) | (patience <= 0)[:, None])
        reached = lengths.isfinite()
        seen &= (reached & ~seen).any(1, True)  # when all is seen, it forgets
        is_over = reset | seen.gather(1, target)[:, 0]
        costs = torch.where(reached & ~seen, lengths + AROUND * bearing.abs(), torch.inf)
        nearest = costs.argmin(1)
        length = lengths.gather(1, nearest[:, None])[:, 0].clamp(max=1e3)
        steps = EXPLORER_PATIENCE + EXPLORER_PATIENCE * length
        return arrdict(
            seen=seen,
            target=torch.where(is_over, nearest, target[:, 0]),
            patience=torch.where(is_over, steps.long(), patience),
        )
