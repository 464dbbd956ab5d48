"""A bot that walks along shortest paths. N environments, n lanes."""

import copy
from collections.abc import Mapping
from typing import Any

import torch

from megastep.agents.selfplay.bots.steering import Steering
from megastep.arrdict import arrdict

ARRIVED = 0.3  # metres
PATIENCE, PER_METRE = 20, 20  # steps after which it gives up a target, and more per metre


class Walker:
    """Walks along shortest paths: to the goals of PointGoal, elsewhere to one landmark after the
    other, drawn at random.

    It knows the floor plans, its pose and the goals.

    Args:
        env: the environment that it plays in.
        steering: how it walks there. Default: to the goals of PointGoal, elsewhere to landmarks.
    """

    def __init__(self, env: Any, steering: Steering | None = None):
        self.goal_index = getattr(env, "goal_index", None)
        goals = env.goals.points if hasattr(env, "goal_index") else None
        self.steering = steering or Steering(env, goals)

    def in_lanes(self, lanes: torch.Tensor) -> "Walker":
        """Returns one that plays in lanes (n,) int64 of the environment."""
        walker = copy.copy(self)
        walker.steering = self.steering.in_lanes(lanes)
        return walker

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the initial state, (n,) each: the target's number, and steps until it is given
        up.
        """
        target, patience = torch.zeros(2, n_lanes, dtype=torch.int64, device=device).unbind()
        return arrdict(target=target, patience=patience)

    def __call__(
        self,
        world: Mapping,
        state: Mapping,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, arrdict]:
        """Returns (arrdict(actions (n, 1)), next state)."""
        steering, patience = self.steering, state["patience"] - 1
        pose = steering.pose()
        near = steering.near(pose)
        if self.goal_index is not None:
            target = self.goal_index[steering.lanes].long()
        else:
            target = state["target"]
            goal = steering.plans.targets[pose.plan, target]
            is_over = (goal - pose.position).norm(dim=-1) < ARRIVED
            is_over |= world["reset"] | (patience <= 0)
            lengths = steering.lengths(near).float()
            draws = torch.rand(lengths.shape, generator=generator, device=target.device)
            drawn = (draws * lengths.isfinite()).argmax(1)
            steps = PATIENCE + PER_METRE * lengths.gather(1, drawn[:, None])[:, 0].clamp(max=1e3)
            target = torch.where(is_over, drawn, target)
            patience = torch.where(is_over, steps.long(), patience)
        aim = steering.aim(pose, near, target)
        decision = steering.decide(pose, aim, aim, turning=0.0)
        return decision, arrdict(target=target, patience=patience)
