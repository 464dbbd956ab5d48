"""PointGoal: navigate to a point given by its distance and bearing. A step is one operation,
:func:`pointgoal_step`.

N environments, A agents each, B = N A lanes. The environment has one agent.
"""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import torch
from pydantic import Field

from megastep import modules, spaces
from megastep.arrdict import arrdict
from megastep.coefficients import Coefficients
from megastep.dotdict import dotdict
from megastep.engine import Resets, checks
from megastep.engine.agents import Agents, check_on_cpu
from megastep.engine.launch_params import lanes_of, seed_params, world_params
from megastep.engine.scenery import Scenery
from megastep.envs.common import Weight, world_of
from megastep.envs.first_person import FirstPerson, images
from megastep.envs.pointgoal.goals import GoalFields, goal_fields
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import launch
from megastep.modules.lifecycle import derived_seed
from megastep.settings import checked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["PointGoal", "PointGoalStep", "pointgoal_step"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
PROGRESS_ROWS = LIBRARY.constants["PROGRESS_ROWS"]  # numbers that describe an episode so far
N_PRIVILEGED = LIBRARY.constants["N_PRIVILEGED"]  # numbers that a critic sees
METRICS = "success", "spl", "soft_spl", "collisions"
REACH = 0.2  # metres from the goal that count as success


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
    privileged_out = None
    if checks.flag("privileged", privileged):
        privileged_out = torch.empty((n_lanes, 1, N_PRIVILEGED), device=device)
    flags = [torch.empty(n_lanes, dtype=torch.bool, device=device) for _ in range(3)]
    metrics = torch.empty((len(METRICS), n_lanes), device=device)
    goal_obs = torch.empty((n_lanes, 1, 3), dtype=torch.float16, device=device)
    reward = torch.empty(n_lanes, device=device)
    outputs = dict(metrics=metrics, goal_obs=goal_obs, privileged=privileged_out)
    out = PointGoalStep(reward, *flags, **outputs)
    counters = dict(n_draws=n_draws, goal_index=goal_index, ages=ages)
    rows = PROGRESS_ROWS, n_lanes
    launch(
        *(LIBRARY, "pointgoal_step", device, n_lanes),
        **world_params(scenery, agents, "positions", "angles"),
        free=checks.optional("free", free, lanes, torch.float32, device),
        spawn_index=checks.address("spawn_index", spawn_index, lanes, torch.int32, device),
        **goals.addresses,
        **checks.addresses((n_lanes,), torch.int32, device, **counters),
        progress=checks.address("progress", progress, rows, torch.float32, device),
        ended=checks.address("ended", ended, (n_lanes,), torch.bool, device),
        **out._asdict(),
        **seed_params(seed),
        per_cell=1 / goals.cell,
        reach=checks.number("reach", reach, -math.inf, math.inf),
        bonus=checks.weight("bonus", bonus, device),
        cost=checks.weight("cost", cost, device),
        walk_cost=checks.weight("walk_cost", walk_cost, device),
        limit=checks.integer("limit", limit, 1, 2**31 - 1),
        n_goals=goals.n_goals,
        n_spawns=goals.n_spawns,
    )
    check_on_cpu(agents)
    return out


class PointGoal(FirstPerson):
    """Point-goal navigation: walk to a point given by its distance and bearing.

    Observation:
        ``rgb``, ``d`` and ``imu`` of :class:`~megastep.envs.first_person.FirstPerson`, and float16
        ``goal``: (B, 1, 3), in the agent's frame: straight-line distance / 10 m, cosine and sine
        of the bearing.

    Actions:
        Those of :class:`~megastep.envs.first_person.FirstPerson`.

    Reward:
        Metres by which the shortest path to the goal became shorter, minus ``cost``, minus
        ``walk_cost`` per metre walked, plus ``bonus`` at success.

    Episode end:
        Terminal within 0.2 m of the goal (success). Truncated after ``limit`` steps.

    Metrics:
        ``success``: 1 if the goal was reached.
        ``spl``: success weighted by path length (Anderson et al. 2018): 0 without success, else the
            length of the shortest path divided by the length walked, at most 1.
        ``soft_spl``: the same with the fraction of the distance covered in place of success (Datta
            et al. 2020).
        ``collisions``: steps that a wall cut short.

    Args:
        nearest: minimum length of the shortest path to a goal, in metres.
        furthest: maximum length of the shortest path to a goal, in metres.
        limit: steps after which an episode is truncated.
        bonus: reward for success. As the costs it is a number or a schedule.
        cost: subtracted from the reward of every step.
        walk_cost: subtracted from the reward per metre walked. SPL counts metres, ``cost`` steps.
        privileged: worlds hold ``privileged.way`` (1, 4) for a critic: tens of metres to go by the
            shortest path, the slope of that distance ahead and to the left, and the fraction of the
            steps that is left.
    """

    @checked
    def __init__(
        self,
        *shared: Any,
        nearest: Annotated[float, Field(ge=0, le=1000)] = 1.0,
        furthest: Annotated[float, Field(gt=0, le=1000)] = 15.0,
        limit: Annotated[int, Field(ge=1, le=10**6)] = 500,
        bonus: Weight = 5.0,
        cost: Weight = 0.02,
        walk_cost: Weight = 0.0,
        privileged: bool = False,
        **options: Any,
    ):
        self.range, self.limit = (nearest, furthest), limit
        super().__init__(*shared, **options)
        self.seed = derived_seed(self.core.seed, "pointgoal")
        self.weights = Coefficients(self.device, bonus=bonus, cost=cost, walk_cost=walk_cost)
        self.coefficients = (self.weights,)
        bounds: dict = dict(low=(0, -1, -1), high=(math.inf, 1, 1))
        self.obs_space["goal"] = spaces.MultiVector(1, 3, **bounds)
        if privileged:
            self.privileged_space = dotdict(way=spaces.MultiVector(1, N_PRIVILEGED))
        self.goal_index, self.n_draws = self._integers(), self._integers()
        self.progress = torch.zeros((PROGRESS_ROWS, self.n_envs), device=self.device)
        self._resets = Resets(lanes_last=("progress",))

    def _furnish(self, geometries, resample) -> modules.RandomSpawns:
        self.goals = goal_fields(geometries, self.core, *self.range)
        points = self.goals.spawns
        return modules.RandomSpawns(geometries, self.core, resample=resample, points=points)

    def _world(self, free=None) -> arrdict:
        self.spawner(self.ended)
        view = images(self._view())
        step = pointgoal_step(
            self.core.scenery,
            self.core.agents,
            self.goals,
            self.goal_index,
            self.progress,
            self.ages,
            self.ended,
            self.n_draws,
            self.spawner.point_index,
            free,
            seed=self.seed,
            reach=REACH,
            limit=self.limit,
            privileged=self.privileged_space is not None,
            **self.weights.tensors,
        )
        world = world_of(
            step, arrdict(view, goal=step.goal_obs), arrdict(zip(METRICS, step.metrics.unbind()))
        )
        if step.privileged is not None:
            world["privileged"] = arrdict(way=step.privileged)
        return world

    def state(self, e: int = 0) -> arrdict:
        """Returns environment ``e`` for :meth:`plot_state`."""
        layout, goal = self.layout[e].long(), self.goal_index[e].long()
        _, _, distance, _, shortest, walked, _ = self.progress[:, e].clone()
        return arrdict(
            self._seen_by(e),
            core=self.core.state(e),
            goal=self.goals.points[layout, goal].clone(),
            age=self.ages[e].clone(),
            distance=distance,
            shortest=shortest,
            walked=walked,
        )

    @classmethod
    def plot_state(cls, state: arrdict) -> "Figure":
        """Draws a numpyified :meth:`state` as a matplotlib figure: the floor plan with the goal,
        and the agent's RGB and depth.
        """
        title = (
            f"step {state.age} · {state.distance:.1f} of {state.shortest:.1f} m to go"
            f" · {state.walked:.1f} m walked"
        )
        return cls._draw(state, title, (state.goal, REACH))
