"""PointGoal: go to a point that is given by distance and bearing.

N environments of one agent, so N lanes.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import torch
from pydantic import Field

from .. import engine, modules, plotting, spaces
from .. import geometries as sources
from ..arrdict import arrdict, numpyify
from ..core import Core
from ..dotdict import dotdict
from ..scene import scenery
from ..settings import MAX_ENVS, checked

__all__ = ["PointGoal"]

REACHED = 0.2  # metres from the goal: there


class PointGoal:
    """Reward for every metre by which the shortest way to the goal becomes shorter, and ``bonus``
    within 0.2 m of it, which ends the episode; each step costs ``cost``.

    Observation: RGB and depth of 64 pixels, each the mean of 4 rays over 130 degrees, IMU, and the
    goal in the agent's frame: distance straight to it in tens of metres, cosine and sine of its
    bearing. All fp16. Seven actions, with momentum. Terminal at success, truncated after ``limit``
    steps.

    Metrics: ``success``; ``spl``, success weighted by path length (Anderson et al. 2018): 0 without
    success, else the length of the shortest way over that of the agent's, or over itself if that is
    longer; ``soft_spl``, the same with the share of the way that was made in place of success (Datta
    et al. 2020); ``collisions``, steps that a wall cut short.

    Args: ``geometries`` to live in, generated homes by default; ``nearest`` and ``furthest`` metres
    that the shortest way to a goal may be; ``limit`` steps; ``bonus`` and ``cost``; ``res`` rays and
    ``subsample`` rays per pixel; ``fov`` degrees; ``fps`` steps per second; ``resample``: every
    episode in a home drawn anew, instead of one home per environment for ever; ``privileged``:
    worlds also tell a critic the distance by the shortest way and its gradient.
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
        self.subsample, self.bonus, self.cost = subsample, bonus, cost
        self.goals = modules.RandomGoals(geometries, self.core, nearest, furthest)
        self.spawner = modules.RandomSpawns(
            geometries, self.core, resample=resample, points=self.goals.spawns
        )
        self.movement = modules.MomentumMovement(self.core)
        self.lifecycle = modules.Lifecycle(self.core, limit)
        self.obs_space = dotdict(
            rgb=modules.RGB(self.core, subsample).space,
            d=modules.Depth(self.core, subsample).space,
            imu=spaces.MultiVector(1, 3),
            goal=spaces.MultiVector(1, 3),
        )
        self.action_space = self.movement.space
        self.privileged_space = None
        if privileged:
            self.units = torch.tensor([10.0, 1.0, 1.0, limit], device=self.device)
            self.privileged_space = dotdict(way=spaces.MultiVector(1, 4))
        self.places = self.core.agents.positions.clone()  # where the agents were a step ago
        # by the shortest way in metres: now, at the start; and metres and collisions since then
        self.distances, self.first, self.travelled, self.collisions = (
            torch.zeros(n_envs, device=self.device) for _ in range(4)
        )

    def reset(self) -> arrdict:
        """Starts every episode anew. Returns a world."""
        return self._world(self.lifecycle.start_all())

    def step(self, decision: Mapping) -> arrdict:
        """One step by ``decision.actions`` (B, 1). Returns a world."""
        free = self.movement(decision).progress
        # in double precision, as PyTorch's root of a float has other last bits on a CPU
        moved = (self.core.agents.positions - self.places).double().square().sum(-1).sqrt()
        self.travelled += modules.to_lanes(moved)
        self.collisions += modules.to_lanes(free < 1)
        return self._world(self.lifecycle.start_ended())

    def _world(self, reset):
        core, goals = self.core, self.goals
        self.spawner(reset)
        goals(reset, self.spawner.chosen)
        view = engine.observe(core.scenery, core.agents, self.subsample, imu=True)
        way = engine.to_goal(core.scenery, core.agents, goals.fields, goals.chosen)
        self.places.copy_(core.agents.positions)
        for count in (self.travelled, self.collisions):
            count.masked_fill_(reset, 0.0)

        known = way.distance.flatten()
        distances = torch.where(known.isfinite(), known, self.distances)
        progress = self.distances - distances
        self.distances.copy_(distances)
        self.first.copy_(torch.where(reset, distances, self.first))
        there = way.straight.flatten() <= REACHED
        reward = (progress + self.bonus * there - self.cost).masked_fill_(reset, 0.0)
        world = arrdict(
            obs=arrdict(
                rgb=view.rgb.view(self.n_envs, *self.obs_space.rgb.shape),
                d=view.depth.view(self.n_envs, *self.obs_space.d.shape),
                imu=view.imu,
                goal=way.bearing,
            ),
            reward=reward,
            metrics=self._metrics(there),
            **self.lifecycle(reset, there),
        )
        if self.privileged_space is not None:
            world["privileged"] = arrdict(way=self._privileged(way))
        return world

    def _metrics(self, there):
        """Of the episodes as they stand (N,) each, which counts where they end."""
        shortest = self.goals.lengths.flatten()
        efficiency = shortest / torch.maximum(shortest, self.travelled).clamp_(min=1e-3)
        made = (1 - self.distances / self.first.clamp(min=1e-3)).clamp_(0, 1)
        return arrdict(
            success=there.float(),
            spl=there * efficiency,
            soft_spl=torch.where(there, 1.0, made) * efficiency,
            collisions=self.collisions.clone(),
        )

    def _privileged(self, way):
        """What only a critic sees (N, 1, 4): the shortest way in tens of metres, how its length falls
        per metre ahead and left, and the share of the steps that is left.
        """
        left = self.lifecycle.limits - self.lifecycle.ages
        columns = self.distances, way.descent[:, 0, 0], way.descent[:, 0, 1], left
        return torch.stack(columns, -1)[:, None] / self.units

    def check(self) -> None:
        """EngineError if the engine has flagged an error since the last check. Waits for the
        device, so not for inside a step.
        """
        engine.check(self.core.agents)

    @property
    def layout(self) -> torch.Tensor:
        """(N,) int32: the layout that each environment shows now, an index into ``geometries``."""
        return self.core.scenery.layout

    def state(self, e: int = 0) -> arrdict:
        """What :meth:`plot_state` draws of environment ``e``."""
        core, goals = self.core, self.goals
        view = engine.observe(core.scenery, core.agents, self.subsample)
        layout = self.layout[e].long()
        return arrdict(
            core=core.state(e),
            rgb=view.rgb.view(self.n_envs, *self.obs_space.rgb.shape)[e],
            d=view.depth.view(self.n_envs, *self.obs_space.d.shape)[e],
            goal=goals.fields.points[layout, goals.chosen[e, 0].long()],
            distance=self.distances[e].clone(),
            travelled=self.travelled[e].clone(),
            shortest=goals.lengths[e, 0].clone(),
            lifecycle=self.lifecycle.state(e),
        )

    @classmethod
    def plot_state(cls, state: arrdict) -> Any:
        """A matplotlib figure of a numpyified :meth:`state`: the plan with the goal, and what the
        agent sees.
        """
        title = (
            f"step {state.lifecycle.age[0]}, {state.distance:.1f} m to go, {state.travelled:.1f} m "
            f"walked, {state.shortest:.1f} m shortest"
        )
        yaws = state.core.yaws
        figure, plan, strips = plotting.panels(2, title=title, n_cameras=len(yaws))
        distances = engine.AGENT_RADIUS + 10 * (1 - state.d[0].astype("float32"))
        Core.plot_state(state.core, plan, distances=distances)
        plotting.plot_goal(plan, state.goal, REACHED)
        modules.RGB.plot_state(state.rgb, strips[:1], yaws)
        modules.Depth.plot_state(state.d, strips[1:], yaws)
        return figure

    def display(self, e: int = 0) -> Any:
        """Environment ``e`` as it is now, as a matplotlib figure."""
        return self.plot_state(numpyify(self.state(e)))
