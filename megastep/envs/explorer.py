"""Explorer: see as much of a home as you can.

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
from megastep.scene import scenery
from megastep.settings import MAX_ENVS, checked

__all__ = ["Explorer"]


class Explorer(SceneryEnv):
    """Reward for wall texels seen for the first time in an episode, / 64; what the first view shows
    pays nothing.

    Observation: RGB and depth of 64 pixels per camera, each the mean of 4 rays, and IMU, all fp16.
    One camera looks ahead, 130 degrees wide. Seven actions, with momentum. Truncated when the
    episode's length in steps reaches the number of texels seen, the first view's included, + 200.
    Its metric is ``coverage``, the share seen of the texels that a look all round from some spawn
    point can show.

    Args: ``geometries`` to live in, generated homes by default; ``res`` rays and ``subsample`` rays
    per pixel; ``fov`` degrees; ``cameras``, the yaw of each in degrees, 0 ahead and 90 left;
    ``fps`` steps per second; ``patience`` steps; ``resample``: every episode in a home drawn anew,
    instead of one home per environment for ever; ``privileged``: worlds also tell a critic how far
    the episode is and where the texels are that can be seen from some spawn point and have not been
    seen yet.
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
        res: Annotated[int, Field(ge=1, le=1024)] = 256,
        subsample: Annotated[int, Field(ge=1, le=32)] = 4,
        fov: Annotated[float, Field(gt=0, lt=180)] = 130.0,
        cameras: Annotated[Sequence[float], Field(min_length=1, max_length=16)] = (0.0,),
        fps: Annotated[float, Field(ge=1, le=1000)] = 10.0,
        patience: Annotated[int, Field(ge=1, le=10**6)] = 200,
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
            cameras,
            seed,
        )
        self.n_envs, self.device, self.fps = n_envs, self.core.device, self.core.fps
        self.subsample, self.patience = subsample, patience
        self.spawner = modules.RandomSpawns(geometries, self.core, resample=resample)
        self.movement = modules.MomentumMovement(self.core)
        self.lifecycle = modules.Lifecycle(self.core)
        self.obs_space = dotdict(
            rgb=modules.RGB(self.core, subsample).space,
            d=modules.Depth(self.core, subsample).space,
            imu=spaces.MultiVector(1, 3),
        )
        self.action_space = self.movement.space
        self.privileged_space = None
        words = -(-self.core.scenery.layouts.max_texels // 32)
        pixels = self.obs_space.d.H * self.obs_space.d.W
        engine.fit(n_envs, 4 * words + 8 * pixels + 64, self.device)
        self.seen = torch.zeros((n_envs, 1, words), dtype=torch.int32, device=self.device)
        self.visible = modules.visible_texels(self.core.scenery, self.spawner.points)
        if privileged:
            self.units = torch.tensor([200.0, 1000.0, 1000.0, 1000.0], device=self.device)
            self.privileged_space = dotdict(
                episode=spaces.MultiVector(1, 4),
                unseen=spaces.MultiVector(1, engine.BANDS * engine.SECTORS),
            )

    def reset(self) -> arrdict:
        """Starts every episode anew. Returns a world."""
        return self._world(self.lifecycle.start_all())

    def step(self, decision: Mapping) -> arrdict:
        """One step by ``decision.actions`` (B, 1). Returns a world."""
        self.movement(decision)
        return self._world(self.lifecycle.start_ended())

    def _world(self, reset):
        self.spawner(reset)
        clear_mask = modules.to_agents(reset, self.n_agents)
        obs, newly_seen = self._observation(seen=self.seen, clear_mask=clear_mask)
        self.lifecycle.limits.masked_fill_(reset, self.patience).add_(newly_seen)
        reward = (newly_seen / modules.TEXELS_PER_POINT).masked_fill_(reset, 0.0)
        flags = self.lifecycle(reset)
        world = arrdict(obs=obs, reward=reward, metrics=self._metrics(flags.truncated), **flags)
        if self.privileged_space is not None:
            world["privileged"] = self._privileged()
        return world

    def _metrics(self, ends):
        """``coverage`` (N,), of the episodes that end here."""
        ends = modules.to_agents(ends, self.n_agents)
        shares = engine.coverage(self.core.scenery, self.core.agents, self.seen, self.visible, ends)
        return arrdict(coverage=modules.to_lanes(shares))

    def _privileged(self):
        """What only a critic sees, in units that make each number about 1: ``episode`` (N, 1, 4),
        steps left and behind, texels seen and left; ``unseen`` (N, 1, 48), the root of how many are
        left in each band and sector of ``engine.unseen``.
        """
        ages, limits = self.lifecycle.ages, self.lifecycle.limits
        counts = engine.unseen(self.core.scenery, self.core.agents, self.seen, self.visible)
        counts = counts.view(self.n_envs, 1, -1)
        columns = limits - ages, ages, self.n_seen, counts.sum((1, 2), dtype=torch.int32)
        return arrdict(
            episode=torch.stack(columns, -1)[:, None] / self.units,
            # in double precision, as PyTorch's root of a float has other last bits on a CPU
            unseen=(counts.double() / modules.TEXELS_PER_POINT).sqrt_().float(),
        )

    @property
    def n_seen(self) -> torch.Tensor:
        """(N,) int32: texels seen in this episode."""
        return self.lifecycle.limits - self.patience

    def _observation(self, **seen):
        """The observation, and if ``seen`` is given how many texels were new (N,)."""
        view = engine.observe(self.core.scenery, self.core.agents, self.subsample, imu=True, **seen)
        per_camera = view.rgb.view(self.n_envs, 1, -1, 3, self.obs_space.rgb.W)
        obs = arrdict(
            rgb=per_camera.transpose(2, 3),
            d=view.depth.view(self.n_envs, *self.obs_space.d.shape),
            imu=view.imu,
        )
        return obs, modules.to_lanes(view.newly_seen) if seen else None

    def state(self, e: int = 0) -> arrdict:
        """What :meth:`plot_state` draws of environment ``e``."""
        return arrdict(
            core=self.core.state(e),
            obs=self._observation()[0][e],
            seen=self._seen_texels(e),
            n_seen=self.n_seen[e].clone(),
            lifecycle=self.lifecycle.state(e),
        )

    def _seen_texels(self, e):
        """(T,) bool: which of the static texels of environment ``e`` have been seen in this
        episode.
        """
        bits = (
            self.seen[e, 0, :, None] >> torch.arange(32, dtype=torch.int32, device=self.device) & 1
        )
        layouts, d = self.core.scenery.layouts, int(self.core.scenery.layout[e])
        first, last = layouts.texel_starts[layouts.wall_starts[d : d + 2].long()].tolist()
        return bits.flatten()[: last - first].bool()

    @classmethod
    def plot_state(cls, state: arrdict) -> Any:
        """A matplotlib figure of a numpyified :meth:`state`: the plan, bright where it has been
        seen, and what the agent sees.
        """
        steps, n_texels = state.lifecycle.age[0], len(state.seen)
        title = f"step {steps}, {state.n_seen} of {n_texels} texels seen"
        yaws = state.core.yaws
        figure, plan, strips = plotting.panels(2, title=title, n_cameras=len(yaws))
        distances = engine.AGENT_RADIUS + 10 * (1 - state.obs.d[0].astype("float32"))
        Core.plot_state(state.core, plan, seen=state.seen, distances=distances)
        modules.RGB.plot_state(state.obs.rgb, strips[:1], yaws)
        modules.Depth.plot_state(state.obs.d, strips[1:], yaws)
        return figure
