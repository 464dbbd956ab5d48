"""PointGoal: navigate to a point given by its distance and bearing.

N environments of one agent, so B = N lanes.
"""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Literal

import torch
from pydantic import Field

from megastep import engine, modules, plotting, spaces
from megastep import geometries as sources
from megastep.arrdict import arrdict
from megastep.core import Core
from megastep.dotdict import dotdict
from megastep.envs.common import SceneryEnv, images
from megastep.envs.pointgoal.goals import goal_fields
from megastep.envs.pointgoal.step import N_PRIVILEGED, PROGRESS_ROWS, pointgoal_step
from megastep.scene import scenery, spread
from megastep.settings import MAX_ENVS, checked
from megastep.types import Geometries

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["PointGoal"]

METRICS = "success", "spl", "soft_spl", "collisions"
REACH = 0.2  # metres from the goal that count as success


class PointGoal(SceneryEnv):
    """Point-goal navigation: walk to a point given by its distance and bearing.

    Observation:
        A dict of float16, for each of C cameras (1) W = ``res / subsample`` pixels (64).

        - ``rgb``: (B, 1, 3, C, W), linear light. A pixel is the mean of ``subsample`` rays.
        - ``d``: (B, 1, 1, C, W), depth: 1 at the agent's edge, 0 at 10 m and beyond.
        - ``imu``: (B, 1, 3), angular velocity / 360 deg/s, velocity forward and left / 10 m/s.
        - ``goal``: (B, 1, 3), in the agent's frame: straight-line distance / 10 m, cosine and sine
          of the bearing.

    Actions:
        (B, 1) integers: 0 nothing, 1 left, 2 right, 3 forward, 4 back, 5 turn left, 6 turn right.
        They accelerate the agent (:class:`~megastep.modules.MomentumMovement`).

        With ``control="continuous"``: (B, 1, 3) float32 from -1 to 1: push ahead, push left, turn
        left. 1 does what the action forward, left or turn left does; numbers beyond are clipped.

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
        n_envs: number of environments.
        geometries: floor plans. Default: generated homes.
        seed: of textures, spawns, goals and generated homes.
        device: default: a GPU if there is one.
        nearest: minimum length of the shortest path to a goal, in metres.
        furthest: maximum length of the shortest path to a goal, in metres.
        limit: steps after which an episode is truncated.
        bonus: reward for success.
        cost: subtracted from the reward of every step.
        walk_cost: subtracted from the reward per metre walked. SPL counts metres, ``cost`` steps.
        res: rays of each camera.
        subsample: rays per pixel.
        fov: field of view in degrees.
        cameras: yaw of each camera, degrees; 0 looks ahead, 90 left.
        fps: steps per second.
        control: discrete or continuous actions.
        resample: draw a new home for every episode. Default: each environment keeps its home.
        privileged: worlds hold ``privileged.way`` (1, 4) for a critic: tens of metres to go by the
            shortest path, the slope of that distance ahead and to the left, and the fraction of the
            steps that is left.
    """

    n_agents = 1

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 128,
        geometries: Geometries | None = None,
        *,
        seed: int = 1,
        device: torch.device | str | None = None,
        nearest: Annotated[float, Field(ge=0, le=1000)] = 1.0,
        furthest: Annotated[float, Field(gt=0, le=1000)] = 15.0,
        limit: Annotated[int, Field(ge=1, le=10**6)] = 500,
        bonus: Annotated[float, Field(ge=0, le=1000)] = 5.0,
        cost: Annotated[float, Field(ge=0, le=1000)] = 0.02,
        walk_cost: Annotated[float, Field(ge=0, le=1000)] = 0.0,
        res: Annotated[int, Field(ge=1, le=1024)] = 256,
        subsample: Annotated[int, Field(ge=1, le=32)] = 4,
        fov: Annotated[float, Field(gt=0, lt=180)] = 130.0,
        cameras: Annotated[Sequence[float], Field(min_length=1, max_length=16)] = (0.0,),
        fps: Annotated[float, Field(ge=1, le=1000)] = 10.0,
        control: Literal["discrete", "continuous"] = "discrete",
        resample: bool = False,
        privileged: bool = False,
    ):
        if geometries is None:
            geometries = sources.sample("homes", min(n_envs, 512), seed=seed)
        geometries = geometries if resample else spread(geometries, n_envs)
        homes = scenery(geometries, n_agents=1, n_envs=n_envs, seed=seed, device=device)
        self.core = Core(homes, res, fov, fps, cameras, seed)
        self.n_envs, self.device, self.fps = n_envs, self.core.device, self.core.fps
        self.subsample, self.seed = subsample, seed + (2 << 32)  # not the spawns' seed
        self.rules: dict = dict(
            bonus=bonus, cost=cost, walk_cost=walk_cost, limit=limit, reach=REACH
        )
        self.goals = goal_fields(geometries, self.core, nearest, furthest)
        self.spawner = modules.RandomSpawns(
            geometries, self.core, resample=resample, points=self.goals.spawns
        )
        self.movement = modules.MomentumMovement(self.core, control=control)
        self.obs_space = dotdict(
            rgb=modules.RGB(self.core, subsample).space,
            d=modules.Depth(self.core, subsample).space,
            imu=spaces.MultiVector(1, 3),
            goal=spaces.MultiVector(1, 3, low=(0, -1, -1), high=(math.inf, 1, 1)),
        )
        self.action_space = self.movement.space
        self.privileged_space = (
            dotdict(way=spaces.MultiVector(1, N_PRIVILEGED)) if privileged else None
        )
        engine.fit(n_envs, 8 * self.obs_space.d.H * self.obs_space.d.W + 64, self.device)
        self.goal_index, self.ages, self.n_draws = (
            torch.zeros(n_envs, dtype=torch.int32, device=self.device) for _ in range(3)
        )
        self.ended = torch.zeros(n_envs, dtype=torch.bool, device=self.device)
        self.progress = torch.zeros((PROGRESS_ROWS, n_envs), device=self.device)
        self._resets = engine.Resets(lanes_last=("progress",))

    def _begin(self, mask) -> arrdict:
        self.ended.copy_(mask)
        return self._world()

    def desync(self) -> None:
        """Gives every lane a random age, from the seed, so that episodes do not end together."""
        limits = torch.full_like(self.ages, self.rules["limit"])
        self.ages.copy_(modules.random_ages(limits, self.core.seed))

    def step(self, decision: Mapping) -> arrdict:
        """Takes one step with ``decision.actions``. Returns a world."""
        return self._resets.keep(self._world(self.movement(decision).progress))

    def _world(self, free=None) -> arrdict:
        """Respawns agents whose episode has ended, renders, and computes rewards and flags."""
        self.spawner(self.ended)
        obs = self._view()
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
            privileged=self.privileged_space is not None,
            **self.rules,
        )
        world = arrdict(
            obs=arrdict(obs, goal=step.goal_obs),
            reward=step.reward,
            reset=step.reset,
            terminal=step.terminal,
            truncated=step.truncated,
            metrics=arrdict(zip(METRICS, step.metrics.unbind())),
        )
        if step.privileged is not None:
            world["privileged"] = arrdict(way=step.privileged)
        return world

    def _view(self, core=None) -> arrdict:
        """Returns the observation without the goal."""
        core = core or self.core
        view = engine.observe(core.scenery, core.agents, self.subsample, imu=True)
        return arrdict(images(view), imu=view.imu)

    def state(self, e: int = 0) -> arrdict:
        """Returns environment ``e`` for :meth:`plot_state`."""
        layout, goal = self.layout[e].long(), self.goal_index[e].long()
        _, _, distance, _, shortest, walked, _ = self.progress[:, e].clone()
        return arrdict(
            self._view(self.core.alone(e)).map(lambda leaf: leaf[0]),
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
        yaws = state.core.yaws
        figure, plan, strips = plotting.panels(2, title=title, n_cameras=len(yaws))
        Core.plot_state(state.core, plan)
        plotting.plot_goal(plan, state.goal, REACH)
        modules.RGB.plot_state(state.rgb, strips[:1], yaws)
        modules.Depth.plot_state(state.d, strips[1:], yaws)
        return figure
