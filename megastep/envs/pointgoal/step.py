"""One step of PointGoal as one operation. N environments, A agents each, B = N A lanes."""

import math
from pathlib import Path
from typing import NamedTuple

import torch

from megastep.engine import checks
from megastep.engine.agents import Agents, check_on_cpu
from megastep.engine.launch_params import (
    error_flag_address,
    lanes_of,
    scenery_params,
    seed_params,
    state_params,
)
from megastep.engine.scenery import Scenery
from megastep.envs.pointgoal.goal_fields import GoalFields
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import launch

__all__ = ["N_PRIVILEGED", "PROGRESS_ROWS", "PointGoalStep", "pointgoal_step"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
PROGRESS_ROWS = LIBRARY.constants["PROGRESS_ROWS"]  # numbers that describe an episode so far
N_PRIVILEGED = LIBRARY.constants["N_PRIVILEGED"]  # numbers that a critic sees


class PointGoalStep(NamedTuple):
    """The outcome of a step, one row per lane."""

    reward: torch.Tensor  # (B,)
    reset: torch.Tensor  # (B,) bool
    terminal: torch.Tensor  # (B,) bool
    truncated: torch.Tensor  # (B,) bool
    metrics: torch.Tensor  # (4, B): success, SPL, soft SPL, collisions where an episode ends
    goal_obs: torch.Tensor  # (B, 1, 3) fp16: distance / 10 m, cosine and sine of the bearing
    privileged: torch.Tensor | None  # (B, 1, 4) for a critic; None if not wanted


def pointgoal_step(
    scenery: Scenery,
    agents: Agents,
    goals: GoalFields,
    goal_index: torch.Tensor,
    progress: torch.Tensor,
    ages: torch.Tensor,
    ended: torch.Tensor,
    n_draws: torch.Tensor,
    spawn_index: torch.Tensor,
    free: torch.Tensor | None = None,
    *,
    seed: int = 1,
    reach: float = 0.2,
    bonus: float | torch.Tensor = 5.0,
    cost: float | torch.Tensor = 0.02,
    walk_cost: float | torch.Tensor = 0.0,
    limit: int = 500,
    privileged: bool = False,
) -> PointGoalStep:
    """Rewards each agent for getting closer to its goal by the shortest path, and observes the
    goal. An agent that starts an episode draws a goal. See :class:`~megastep.envs.PointGoal`.

    Args:
        goals: of the scenery's layouts.
        goal_index: (B,) int32, each agent's goal among its layout's, updated in place.
        progress: (7, B) float32, updated in place. Rows: x and y one step ago; metres to go by the
            shortest path, now and at the start; length of the shortest path from the start; metres
            walked; collisions.
        ages: (B,) int32, steps since the first observation, updated in place.
        ended: (B,) bool, updated in place. In: lanes that start an episode in this step. Out: lanes
            whose episode ends in this step.
        n_draws: (B,) int32, goals drawn so far, the generator's counter, updated in place.
        spawn_index: (N, A) int32, the spawn points of lanes that start an episode.
        free: (N, A) float32, ``progress`` of :func:`~megastep.engine.physics`, or None if no step
            was taken.
        seed: the generator's key.
        reach: metres; an agent this close to its goal succeeds.
        bonus: reward for success; as the costs a number, or a tensor () on the device.
        cost: subtracted from the reward of every step.
        walk_cost: subtracted from the reward per metre walked.
        limit: steps after which an episode is truncated.
        privileged: compute the privileged observation: tens of metres to go, the slope of that
            distance ahead and to the left, and the fraction of the steps that is left.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
        EngineError: on the CPU, if a position is NaN or an index is out of range.
    """
    n, a = lanes = lanes_of(scenery, agents)
    device, n_lanes = scenery.device, n * a
    checks.instance("goals", goals, GoalFields)
    if goals.n_layouts != len(scenery.layouts) or goals.device != device:
        raise ValueError(
            f"goals must be for the {len(scenery.layouts)} layouts of the scenery, on {device}, "
            f"but they are for {goals.n_layouts} on {goals.device}"
        )
    rewards = dict(bonus=bonus, cost=cost, walk_cost=walk_cost)
    rewards = {name: checks.weight(name, value, device) for name, value in rewards.items()}
    checks.number("reach", reach, -math.inf, math.inf)
    flags = [torch.empty(n_lanes, dtype=torch.bool, device=device) for _ in range(3)]
    privileged_out = None
    if checks.flag("privileged", privileged):
        privileged_out = torch.empty((n_lanes, 1, N_PRIVILEGED), device=device)
    out = PointGoalStep(
        torch.empty(n_lanes, device=device),
        *flags,
        metrics=torch.empty((4, n_lanes), device=device),
        goal_obs=torch.empty((n_lanes, 1, 3), dtype=torch.float16, device=device),
        privileged=privileged_out,
    )
    launch(
        *(LIBRARY, "pointgoal_step", device, n_lanes),
        scenery=scenery_params(scenery, agents.radius),
        **state_params(scenery, agents, "positions", "angles"),
        free=0 if free is None else checks.address("free", free, lanes, torch.float32, device),
        spawn_index=checks.address("spawn_index", spawn_index, lanes, torch.int32, device),
        **goals.addresses,
        n_draws=checks.address("n_draws", n_draws, (n_lanes,), torch.int32, device),
        goal_index=checks.address("goal_index", goal_index, (n_lanes,), torch.int32, device),
        progress=checks.address(
            "progress", progress, (PROGRESS_ROWS, n_lanes), torch.float32, device
        ),
        ages=checks.address("ages", ages, (n_lanes,), torch.int32, device),
        ended=checks.address("ended", ended, (n_lanes,), torch.bool, device),
        error_flag=error_flag_address(scenery, agents),
        **out._asdict(),
        **seed_params(seed),
        per_cell=1 / goals.cell,
        reach=reach,
        **rewards,
        limit=checks.integer("limit", limit, 1, 2**31 - 1),
        n_goals=goals.n_goals,
        n_spawns=goals.n_spawns,
    )
    check_on_cpu(agents)
    return out
