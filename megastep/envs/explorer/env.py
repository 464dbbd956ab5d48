"""Explorer: see as much of a home as possible. N environments of one agent each, so B = N lanes."""

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
from megastep.envs.explorer.step import N_BINS, N_EPISODE, explorer_step
from megastep.envs.explorer.texel_runs import TexelRuns
from megastep.scene import scenery, spread
from megastep.settings import MAX_ENVS, checked
from megastep.types import Geometries

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Explorer"]


class Explorer(SceneryEnv):
    """An agent explores a floor plan. New wall texels (5 cm each) that it sees are the reward.

    Observation:
        A dict of float16, W = ``res / subsample`` pixels (64) for each of C cameras (1).

        - ``rgb``: (B, 1, 3, C, W), linear light. A pixel is the mean of ``subsample`` rays.
        - ``d``: (B, 1, 1, C, W), depth: 1 at the agent's edge, 0 at 10 m and beyond.
        - ``imu``: (B, 1, 3), angular velocity / 360 deg/s, velocity forward and left / 10 m/s.

    Actions:
        (B, 1) integers: 0 nothing, 1 left, 2 right, 3 forward, 4 back, 5 turn left, 6 turn right.
        They accelerate the agent (:class:`~megastep.modules.MomentumMovement`).

        With ``control="continuous"``: (B, 1, 3) float32 from -1 to 1: push ahead, push left, turn
        left. 1 does what the action forward, left or turn left does; numbers beyond are clipped.

    Reward:
        Number of texels seen for the first time this episode, divided by 64. The first observation
        gives 0.

    Episode end:
        Truncated after ``patience`` + (texels seen) steps, so an agent that finds nothing new times
        out. Texels of the first observation count. Never terminal.

    Metrics:
        ``coverage``: texels seen, divided by the texels that are visible from the spawn points.

    Args:
        n_envs: number of environments, N.
        geometries: floor plans. Default: generated homes, at most 512.
        seed: of textures, lights, spawns, and of the homes drawn by default.
        device: where the tensors are. Default: a GPU if there is one.
        res: rays per camera.
        subsample: rays per pixel; divides ``res``.
        fov: field of view of a camera, degrees.
        cameras: yaw of each camera, degrees; 0 looks ahead, 90 left.
        fps: steps per second of simulated time.
        patience: an episode is truncated after this many steps plus the texels seen.
        control: discrete or continuous actions.
        resample: if True, each episode takes place in a randomly drawn floor plan. Otherwise an
            environment keeps its own.
        privileged: if True, worlds have ``privileged`` for a critic: ``episode`` (B, 1, 4), steps
            left and taken, texels seen and left; ``unseen`` (B, 1, 48), where around the agent the
            visible texels lie that it has not seen yet.
        metrics: if False, worlds have no ``metrics``.
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
        res: Annotated[int, Field(ge=1, le=1024)] = 256,
        subsample: Annotated[int, Field(ge=1, le=32)] = 4,
        fov: Annotated[float, Field(gt=0, lt=180)] = 130.0,
        cameras: Annotated[Sequence[float], Field(min_length=1, max_length=16)] = (0.0,),
        fps: Annotated[float, Field(ge=1, le=1000)] = 10.0,
        patience: Annotated[int, Field(ge=1, le=10**6)] = 200,
        control: Literal["discrete", "continuous"] = "discrete",
        resample: bool = False,
        privileged: bool = False,
        metrics: bool = True,
    ):
        if geometries is None:
            geometries = sources.sample("homes", min(n_envs, 512), seed=seed)
        geometries = geometries if resample else spread(geometries, n_envs)
        homes = scenery(geometries, n_agents=1, n_envs=n_envs, seed=seed, device=device)
        self.core = Core(homes, res, fov, fps, cameras, seed)
        self.n_envs, self.device, self.fps = n_envs, self.core.device, self.core.fps
        self.subsample, self.patience, self.has_metrics = subsample, patience, metrics
        self.spawner = modules.RandomSpawns(geometries, self.core, resample=resample)
        self.movement = modules.MomentumMovement(self.core, control=control)
        self.lifecycle = modules.Lifecycle(self.core)
        self.obs_space = dotdict(
            rgb=modules.RGB(self.core, subsample).space,
            d=modules.Depth(self.core, subsample).space,
            imu=spaces.MultiVector(1, 3),
        )
        self.action_space = self.movement.space
        self._resets = engine.Resets()
        self.privileged_space = None
        words = -(-self.core.scenery.layouts.max_texels // 32)
        pixels = self.obs_space.d.H * self.obs_space.d.W
        engine.fit(n_envs, 4 * words + 8 * pixels + 64, self.device)
        self.seen = torch.zeros((n_envs, 1, words), dtype=torch.int32, device=self.device)
        self.runs = None
        if metrics or privileged:
            self.visible = modules.visible_texels(self.core.scenery, self.spawner.points)
            self.runs = TexelRuns(self.core.scenery, self.visible)
        if privileged:
            self.privileged_space = dotdict(
                episode=spaces.MultiVector(1, N_EPISODE), unseen=spaces.MultiVector(1, N_BINS)
            )

    def _begin(self, mask) -> arrdict:
        self.lifecycle.ended.copy_(mask)
        return self._world()

    def desync(self) -> None:
        """Gives every lane a random age, from the seed, so that episodes do not end together."""
        self.lifecycle.desync()

    def step(self, decision: Mapping) -> arrdict:
        """Takes one step by ``decision["actions"]``. Returns a world."""
        self.movement(decision)
        return self._resets.keep(self._world())

    def _world(self) -> arrdict:
        """Respawns agents whose episode has ended, renders, and computes rewards and flags."""
        ages, limits, ended = self.lifecycle.ages, self.lifecycle.limits, self.lifecycle.ended
        self.spawner(ended)
        obs, newly_seen = self._observation(seen=self.seen, clear_mask=ended[:, None])
        assert newly_seen is not None
        step = explorer_step(
            self.core.scenery,
            self.core.agents,
            newly_seen,
            self.seen,
            self.runs,
            ages,
            limits,
            ended,
            patience=self.patience,
            coverage=self.has_metrics,
            privileged=self.privileged_space is not None,
        )
        world = arrdict(
            obs=obs,
            reward=step.reward,
            reset=step.reset,
            terminal=step.terminal,
            truncated=step.truncated,
        )
        if step.coverage is not None:
            world["metrics"] = arrdict(coverage=step.coverage)
        if step.unseen is not None:
            world["privileged"] = arrdict(episode=step.episode, unseen=step.unseen)
        return world

    @property
    def n_seen(self) -> torch.Tensor:
        """(B,) int32: texels seen this episode."""
        return self.lifecycle.limits - self.patience

    def _observation(self, core=None, **bitmaps) -> tuple[arrdict, torch.Tensor | None]:
        """Returns the observation and the number of newly seen texels, (N, 1) int32.

        Args:
            core: default: that of all environments.

        Without ``bitmaps`` (arguments ``seen`` and ``clear_mask`` of ``engine.observe``) the number
        is None.
        """
        core = core or self.core
        view = engine.observe(core.scenery, core.agents, self.subsample, imu=True, **bitmaps)
        return arrdict(images(view), imu=view.imu), view.newly_seen

    def state(self, e: int = 0) -> arrdict:
        """Returns the tensors of environment ``e`` that :meth:`plot_state` draws."""
        return arrdict(
            core=self.core.state(e),
            obs=self._observation(self.core.alone(e))[0][0],
            seen=self._texels(self.seen[e, 0], e),
            visible=self._texels(self._visible_bits(e), e),
            n_seen=self.n_seen[e].clone(),
            lifecycle=self.lifecycle.state(e),
        )

    def _visible_bits(self, e) -> torch.Tensor:
        """(n_words,) int32: texels that ``coverage`` counts, or all without metrics."""
        return self.visible[self.layout[e]] if self.runs else torch.full_like(self.seen[e, 0], -1)

    def _texels(self, words, e) -> torch.Tensor:
        """(T,) bool: the bits (n_words,) of the wall texels of environment ``e``."""
        bits = words[:, None] >> torch.arange(32, dtype=torch.int32, device=self.device) & 1
        layouts, d = self.core.scenery.layouts, int(self.core.scenery.layout[e])
        first, last = layouts.texel_starts[layouts.wall_starts[d : d + 2].long()].tolist()
        return bits.flatten()[: last - first].bool()

    @classmethod
    def plot_state(cls, state: arrdict) -> "Figure":
        """Draws a numpyified :meth:`state`: the floor plan, where walls that were not seen are
        grey, above the agent's images. Returns a matplotlib figure.
        """
        coverage = (state.seen & state.visible).sum() / max(state.visible.sum(), 1)
        title = f"step {state.lifecycle.age[0]} · {100 * coverage:.0f} % seen"
        yaws = state.core.yaws
        figure, plan, strips = plotting.panels(2, title=title, n_cameras=len(yaws))
        Core.plot_state(state.core, plan, state.seen)
        modules.RGB.plot_state(state.obs.rgb, strips[:1], yaws)
        modules.Depth.plot_state(state.obs.d, strips[1:], yaws)
        return figure
