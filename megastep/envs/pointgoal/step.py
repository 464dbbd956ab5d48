"""One step of PointGoal, as one operation of the device. N environments, A agents each, B lanes."""

import math
from typing import NamedTuple

import torch

from megastep.engine import checks
from megastep.engine.agents import Agents, check_on_cpu
from megastep.engine.launch_params import error_flag as error_flag_of
from megastep.engine.launch_params import lanes_of, scenery_params, seed_params, state_params
from megastep.engine.scenery import Scenery
from megastep.envs.pointgoal.goal_fields import GoalFields
from megastep.kernels.build.launch import launch, params

__all__ = ["PROGRESS_ROWS", "PointGoalStep", "pointgoal_step"]

PROGRESS_ROWS = 7  # numbers that are kept of an agent that seeks a goal
TOLD = 4  # numbers that its critic is told


class PointGoalStep(NamedTuple):
    """A step of agents that seek a goal, one value per lane."""

    reward: torch.Tensor  # (B,)
    reset: torch.Tensor  # (B,) bool, as the next two
    terminal: torch.Tensor
    truncated: torch.Tensor
    metrics: torch.Tensor  # (4, B): where an episode ends, success, SPL, soft SPL, collisions
    bearing: torch.Tensor  # (B, 1, 3) fp16: metres / 10 straight, cosine and sine of the bearing
    told: torch.Tensor | None  # (B, 1, 4): what a critic is told; None if not wanted


def pointgoal_step(
    scenery: Scenery,
    agents: Agents,
    goals: GoalFields,
    chosen: torch.Tensor,
    journey: torch.Tensor,
    ages: torch.Tensor,
    ended: torch.Tensor,
    draws: torch.Tensor,
    spawned: torch.Tensor,
    free: torch.Tensor | None = None,
    *,
    seed: int = 1,
    reach: float = 0.2,
    bonus: float = 5.0,
    cost: float = 0.02,
    limit: int = 500,
    told: bool = False,
) -> PointGoalStep:
    """Each agent is told where its goal lies, paid for what the shortest way there has become
    shorter, and done within ``reach`` metres; see :class:`~megastep.envs.PointGoal`. Those that
    begin an episode draw a goal, once from their random stream.

    Args: in place, ``chosen`` (B,) int32, the goals' numbers, ``journey`` (7, B) float32, of which
    rows 2 to 6 are metres to go by the shortest way, the same at the start, the length of the
    shortest way from there, metres walked, and collisions; ``ages`` (B,) int32, ``ended`` (B,)
    bool, lanes that begin an episode in this step, and then those that end theirs, ``draws`` (B,)
    int32, goals drawn so far; ``spawned`` (N, A) int32, the spawn points of those that begin one;
    ``free`` (N, A) float32, the progress of :func:`physics`, None if no step was taken; ``bonus``
    for being there, ``cost`` of a step, ``limit`` steps per episode; ``told``: what a critic is
    told is wanted, too.
    """
    n, a = lanes = lanes_of(scenery, agents)
    on, n_lanes = scenery.device, n * a
    checks.instance("goals", goals, GoalFields)
    if goals.n_layouts != len(scenery.layouts) or goals.device != on:
        raise ValueError(
            f"goals must be of the scenery's {len(scenery.layouts)} layouts and on {on}, but those "
            f"of {goals.n_layouts} on {goals.device} were given"
        )
    for name, value in dict(reach=reach, bonus=bonus, cost=cost).items():
        checks.number(name, value, -math.inf, math.inf)
    flags = [torch.empty(n_lanes, dtype=torch.bool, device=on) for _ in range(3)]
    out = PointGoalStep(
        torch.empty(n_lanes, device=on),
        *flags,
        metrics=torch.empty((4, n_lanes), device=on),
        bearing=torch.empty((n_lanes, 1, 3), dtype=torch.float16, device=on),
        told=torch.empty((n_lanes, 1, TOLD), device=on) if checks.flag("told", told) else None,
    )
    packed = params.SeekParams(
        scenery=scenery_params(scenery, agents.radius),
        **state_params(scenery, agents, "positions", "angles"),
        free=0 if free is None else checks.address("free", free, lanes, torch.float32, on),
        spawned=checks.address("spawned", spawned, lanes, torch.int32, on),
        **goals.addresses,
        draws=checks.address("draws", draws, (n_lanes,), torch.int32, on),
        goals=checks.address("chosen", chosen, (n_lanes,), torch.int32, on),
        journey=checks.address("journey", journey, (PROGRESS_ROWS, n_lanes), torch.float32, on),
        ages=checks.address("ages", ages, (n_lanes,), torch.int32, on),
        ended=checks.address("ended", ended, (n_lanes,), torch.bool, on),
        error_flag=error_flag_of(scenery, agents),
        **{k: 0 if v is None else v.data_ptr() for k, v in out._asdict().items()},
        **seed_params(seed),
        per_cell=1 / goals.cell,
        reach=reach,
        bonus=bonus,
        cost=cost,
        limit=checks.integer("limit", limit, 1, 2**31 - 1),
        n_goals=goals.n_goals,
        n_spawns=goals.n_spawns,
    )
    launch("seek", packed, on, threads=n_lanes)
    check_on_cpu(agents)
    return out
