"""PointGoal: go to a point that is given by distance and bearing.

N environments of one agent, so N lanes.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import torch
from pydantic import Field

from megastep import engine, modules, plotting, spaces
from megastep import geometries as sources
from megastep.arrdict import arrdict
from megastep.core import Core
from megastep.dotdict import dotdict
from megastep.envs.common import SceneryEnv
from megastep.envs.pointgoal.goals import goal_fields
from megastep.envs.pointgoal.step import PROGRESS_ROWS, pointgoal_step
from megastep.scene import scenery
from megastep.settings import MAX_ENVS, checked

__all__ = ["PointGoal"]

METRICS = "success", "spl", "soft_spl", "collisions"
REACH = 0.2  # metres from the goal: there


class PointGoal(SceneryEnv):
    """Reward for every metre by which the shortest way to the goal becomes shorter, and ``bonus``
    within 0.2 m of it, which ends the episode; each step costs ``cost``.

    Observation: RGB and depth of 64 pixels, each the mean of 4 rays over 130 degrees, IMU, and the
    goal in the agent's frame: distance straight to it in tens of metres, cosine and sine of its
    bearing. All fp16. Seven actions, with momentum. Terminal at success, truncated after ``limit``
    steps.

    Metrics: ``success``; ``spl``, success weighted by path length (Anderson et al. 2018): 0 without
    success, else the length of the shortest way over that of the agent's, or over itself if that is
    longer; ``soft_spl``, the same with the share of the way that was made in place of success
    (Datta et al. 2020); ``collisions``, steps that a wall cut short.

    Args: ``geometries`` to live in, generated homes by default; ``nearest`` and ``furthest`` metres
    that the shortest way to a goal may be; ``limit`` steps; ``bonus`` and ``cost``; ``res`` rays
    and ``subsample`` rays per pixel; ``fov`` degrees; ``fps`` steps per second; ``resample``: every
    episode in a home drawn anew, instead of one home per environment for ever; ``privileged``:
    worlds also tell a critic how far the goal is by the shortest way, how that distance falls ahead
    and to the left, and the share of the steps that is left.
    """

    n_agents = 1

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 128,
        geometries: Sequence[Any] | None = None,
        *,
        seed: int = 1,
        device: torch.device | str | None = None,
        nearest: Annotated[float, Field(ge=0, le=1000)] = 1.0,
        furthest: Annotated[float, Field(gt=0, le=1000)] = 15.0,
        limit: Annotated[int, Field(ge=1, le=10**6)] = 500,
        bonus: Annotated[float, Field(ge=0, le=1000)] = 5.0,
        cost: Annotated[float, Field(ge=0, le=1000)] = 0.02,
        res: Annotated[int, Field(ge=1, le=1024)] = 256,
        subsample: Annotated[int, Field(ge=1, le=32)] = 4,
        fov: Annotated[float, Field(gt=0, lt=180)] = 130.0,
        fps: Annotated[float, Field(ge=1, le=1000)] = 10.0,
        resample: bool = False,
        privileged: bool = False,
    ):
        if geometries is None:
            geometries = sources.sample("homes", min(n_envs, 512), seed=seed)
        geometries = geometries if resample else geometries[:n_envs]
        self.core = Core(
            scenery(geometries, n_agents=1, n_envs=n_envs, seed=seed, device=device),
            res,
            fov,
            fps,
            seed=seed,
        )
        self.n_envs, self.device, self.fps = n_envs, self.core.device, self.core.fps
        self.subsample, self.seed = subsample, seed + (2 << 32)  # other draws than the spawns'
        self.rules = dict(bonus=bonus, cost=cost, limit=limit, reach=REACH)
        self.goals = goal_fields(geometries, self.core, nearest, furthest)
        self.spawner = modules.RandomSpawns(
            geometries, self.core, resample=resample, points=self.goals.spawns
        )
        self.movement = modules.MomentumMovement(self.core)
        self.obs_space = dotdict(
            rgb=modules.RGB(self.core, subsample).space,
            d=modules.Depth(self.core, subsample).space,
            imu=spaces.MultiVector(1, 3),
            goal=spaces.MultiVector(1, 3),
        )
        self.action_space = self.movement.space
        self.privileged_space = dotdict(way=spaces.MultiVector(1, 4)) if privileged else None
        self.chosen, self.ages, self.draws = (
            torch.zeros(n_envs, dtype=torch.int32, device=self.device) for _ in range(3)
        )
        self.ended = torch.zeros(n_envs, dtype=torch.bool, device=self.device)
        self.journey = torch.zeros((PROGRESS_ROWS, n_envs), device=self.device)

    def reset(self) -> arrdict:
        """Starts every episode anew. Returns a world."""
        self.ended.fill_(True)
        return self._world()

    def step(self, decision: Mapping) -> arrdict:
        """One step by ``decision.actions`` (B, 1). Returns a world."""
        return self._world(self.movement(decision).progress)

    def _world(self, free=None):
        """Respawns who ended an episode, looks, and judges where the agents have got to."""
        self.spawner(self.ended)
        obs = self._view()
        sought = pointgoal_step(
            self.core.scenery,
            self.core.agents,
            self.goals,
            self.chosen,
            self.journey,
            self.ages,
            self.ended,
            self.draws,
            self.spawner.chosen,
            free,
            seed=self.seed,
            told=self.privileged_space is not None,
            **self.rules,
        )
        world = arrdict(
            obs=arrdict(obs, goal=sought.bearing),
            reward=sought.reward,
            reset=sought.reset,
            terminal=sought.terminal,
            truncated=sought.truncated,
            metrics=arrdict(zip(METRICS, sought.metrics.unbind())),
        )
        if sought.told is not None:
            world["privileged"] = arrdict(way=sought.told)
        return world

    def _view(self):
        """The observation but for the goal."""
        view = engine.observe(self.core.scenery, self.core.agents, self.subsample, imu=True)
        return arrdict(
            rgb=view.rgb.view(self.n_envs, *self.obs_space.rgb.shape),
            d=view.depth.view(self.n_envs, *self.obs_space.d.shape),
            imu=view.imu,
        )

    def state(self, e: int = 0) -> arrdict:
        """What :meth:`plot_state` draws of environment ``e``."""
        layout, goal = self.layout[e].long(), self.chosen[e].long()
        _, _, distance, _, shortest, walked, _ = self.journey[:, e].clone()
        return arrdict(
            self._view().map(lambda leaf: leaf[e]),
            core=self.core.state(e),
            goal=self.goals.points[layout, goal].clone(),
            age=self.ages[e].clone(),
            distance=distance,
            shortest=shortest,
            walked=walked,
        )

    @classmethod
    def plot_state(cls, state: arrdict) -> Any:
        """A matplotlib figure of a numpyified :meth:`state`: the plan with the goal, and what the
        agent sees.
        """
        title = (
            f"step {state.age}, {state.distance:.1f} m to go, {state.walked:.1f} m walked, "
            f"{state.shortest:.1f} m shortest"
        )
        yaws = state.core.yaws
        figure, plan, strips = plotting.panels(2, title=title, n_cameras=len(yaws))
        distances = engine.AGENT_RADIUS + 10 * (1 - state.d[0].astype("float32"))
        Core.plot_state(state.core, plan, distances=distances)
        plotting.plot_goal(plan, state.goal, REACH)
        modules.RGB.plot_state(state.rgb, strips[:1], yaws)
        modules.Depth.plot_state(state.d, strips[1:], yaws)
        return figure
