"""PointGoal: navigate to a point given by its distance and bearing."""

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import torch
from pydantic import Field

from megastep import modules, plotting, spaces
from megastep.arrdict import arrdict
from megastep.coefficients import Coefficients
from megastep.core import Core
from megastep.dotdict import dotdict
from megastep.engine import Resets
from megastep.engine.launch_params import seed_params
from megastep.envs.common import Weight, judged, world_of
from megastep.envs.first_person import FirstPerson, images
from megastep.envs.pointgoal.goals import check_doors, goal_fields
from megastep.geodesics import CELL
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.modules.lifecycle import derived_seed
from megastep.settings import checked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["PointGoal"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
PROGRESS_ROWS = LIBRARY.constants["PROGRESS_ROWS"]  # numbers that describe an episode so far
N_PRIVILEGED = LIBRARY.constants["N_PRIVILEGED"]  # numbers that a critic sees
METRICS = "success", "spl", "soft_spl", "collisions"
REACH = 0.2  # metres from the goal that count as success


class PointGoal(FirstPerson):
    """Point-goal navigation: walk to a point given by its distance and bearing.

    Observation:
        ``rgb``, ``d`` and ``imu`` of :class:`~megastep.envs.first_person.FirstPerson`, and float16
        ``goal``: (B, 1, 3), in the agent's frame: straight-line distance / 10 m, cosine and sine
        of the bearing.

        With a ``robot``: ``goal``; ``odom``: (B, 1, 2), the speed ahead and the rate of turning as
        fractions of the highest; and ``scan``: (B, 1, 1, 1, R), 1 - range / ``range_max`` of R rays
        counter-clockwise from ahead (:class:`~megastep.modules.Lidar`), or ``rgb``.

    Actions:
        Those of :class:`~megastep.envs.first_person.FirstPerson`; with a ``robot``, differential.

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
        robot: what drives: size, limits, lidar. It has differential control. Default: none.
    """

    begins_in_place = True

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
        robot: modules.Robot | None = None,
        **options: Any,
    ):
        self.range, self.limit, self.robot = (nearest, furthest), limit, robot
        super().__init__(*shared, **options)
        self.seed = derived_seed(self.core.seed, "pointgoal")
        self.weights = Coefficients(self.device, bonus=bonus, cost=cost, walk_cost=walk_cost)
        self.coefficients = (self.weights,)
        if robot is not None:
            self.lidar = modules.Lidar(self.core, robot)
            odom = spaces.MultiVector(1, 2, low=-1, high=1)
            is_lidar = robot.sensor == "lidar"
            seen = dict(scan=self.lidar.space) if is_lidar else dict(rgb=self.obs_space.rgb)
            self.obs_space = dotdict(seen, odom=odom)
            self.drive = cast(modules.DifferentialMovement, self.movement)
            self.per_limit = 1 / self.drive.high
        bounds: dict = dict(low=(0, -1, -1), high=(math.inf, 1, 1))
        self.obs_space["goal"] = spaces.MultiVector(1, 3, **bounds)
        if privileged:
            self.privileged_space = dotdict(way=spaces.MultiVector(1, N_PRIVILEGED))
        self.goal_index, self.n_draws = torch.zeros_like(self.ages), torch.zeros_like(self.ages)
        # x and y one step ago; metres to go by the shortest path, now and at the start; length of
        # the shortest path from the start; metres walked; collisions
        self.progress = torch.zeros((PROGRESS_ROWS, self.n_envs), device=self.device)
        self._resets = Resets(lanes_last=("progress",))

    def _furnish(self, geometries, resample) -> modules.RandomSpawns:
        if self.robot is not None:
            check_doors(geometries, self.robot.radius)
        self.goals, points = goal_fields(geometries, self.core, *self.range)
        return modules.RandomSpawns(geometries, self.core, resample=resample, points=points)

    def _world(self, free=None) -> arrdict:
        self.spawner(self._begins)
        out = self._judge(free)
        obs = arrdict(self._sensed(), goal=out["goal_obs"])
        return world_of(out, obs, METRICS, way="privileged")

    def _sensed(self) -> arrdict:
        if self.robot is None:
            return images(self._view())
        odom = (self.drive.twist() * self.per_limit).half().view(-1, 1, 2)
        if self.robot.sensor == "lidar":
            return arrdict(scan=self.lidar().half().view(-1, *self.lidar.space.shape), odom=odom)
        return arrdict(rgb=images(self._view()).rgb, odom=odom)

    def _judge(self, free) -> dict:
        """Rewards agents for getting closer to their goals, and draws those of new episodes."""
        return judged(
            *(self, LIBRARY, "pointgoal_step", len(METRICS)),
            *(dict(goal_obs=3), dict(privileged=N_PRIVILEGED)),
            free=free,
            spawn_index=self.spawner.point_index,
            **self.goals._asdict(),
            last=self.goals.fields[-1:],
            n_draws=self.n_draws,
            goal_index=self.goal_index,
            progress=self.progress,
            **seed_params(self.seed),
            per_cell=1 / CELL,
            reach=REACH,
            **self.weights.tensors,
            limit=self.limit,
            n_goals=self.goals.points.shape[1],
            n_spawns=self.goals.lengths.shape[1],
        )

    def truth(self) -> arrdict:
        """As of :class:`FirstPerson`; the target is the goal."""
        goals = self.goals.points[self.layout.long(), self.goal_index.long()]
        return self._with_target(super().truth(), goals)

    def describe(self) -> dict:
        """Returns what a robot's observations and actions mean, for programs around its policy."""
        if self.robot is None:
            return {}
        robot, limits = dataclasses.asdict(self.robot), [self.robot.speed, self.robot.turn_rate]
        sensors: dict[str, Any] = {
            "goal": ["distance / 10 m", "cosine of the bearing", "sine of the bearing"],
            "odom": [f"speed ahead / {limits[0]:g} m/s", f"turning left / {limits[1]:g} rad/s"],
        }
        if self.robot.sensor == "lidar":
            sensors["scan"] = {
                "value": "1 - clip(range / range_max, 0, 1); 0 also without a return",
                "n_rays": self.robot.n_rays,
                "angle_min": 0.0,  # rad, ahead, then counter-clockwise
                "angle_increment": 2 * math.pi / self.robot.n_rays,
                "range_min": self.robot.range_min,  # m
                "range_max": self.robot.range_max,
            }
        action = {"names": ["linear.x", "angular.z"], "units": ["m/s", "rad/s"], "high": limits}
        task = {"reach": REACH, "limit": self.limit}  # metres, steps
        return {"robot": robot, "observations": sensors, "actions": action, **task}

    def state(self, e: int = 0) -> arrdict:
        """Returns environment ``e`` for :meth:`plot_state`."""
        layout, goal = self.layout[e].long(), self.goal_index[e].long()
        _, _, distance, _, shortest, walked, _ = self.progress[:, e].clone()
        return arrdict(
            self._seen_by(e) if self.robot is None else dict(scan=self.lidar.state(e)),
            core=self.core.state(e),
            goal=self.goals.points[layout, goal].clone(),
            age=self.ages[e].clone(),
            distance=distance,
            shortest=shortest,
            walked=walked,
        )

    @classmethod
    def plot_state(cls, state: arrdict) -> "Figure":
        """Draws a numpyified :meth:`state`: the floor plan with the goal, RGB and depth."""
        title = (
            f"step {state.age} · {state.distance:.1f} of {state.shortest:.1f} m to go"
            f" · {state.walked:.1f} m walked"
        )
        if "scan" not in state:
            return cls._draw(state, title, (state.goal, REACH))
        figure, plan, strips = plotting.panels(1, title=title)
        Core.plot_state(state.core, plan)
        plotting.plot_goal(plan, state.goal, REACH)
        modules.Lidar.plot_state(state.scan, strips)
        return figure
