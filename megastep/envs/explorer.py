"""Explorer: see as much of a home as you can."""

import torch

from .. import engine, modules, plotting, spaces
from .. import geometries as sources
from ..arrdict import arrdict
from ..core import Core
from ..dotdict import dotdict
from ..scene import scenery

TEXELS_A_POINT = 64  # newly seen texels that earn a reward of 1
PATIENCE = 200  # steps an episode lasts beyond one for each texel seen


class Explorer:
    """Reward for wall texels seen for the first time in an episode, / 64; what the first view shows
    pays nothing.

    Observation: RGB and depth of 64 pixels, each the mean of 4 rays over 130 degrees, and IMU, all
    fp16. Seven actions, with momentum. Truncated when the episode's length in steps reaches the
    number of texels seen, the first view's included, + 200.

    Args: ``geometries`` to live in, generated homes by default; ``res`` rays and ``subsample`` rays
    a pixel; ``fov`` degrees; ``patience`` steps; ``resample``, every episode in a home drawn anew,
    instead of one home a world for ever.
    """

    n_agents = 1

    def __init__(
        self,
        n_envs=128,
        geometries=None,
        *,
        seed=1,
        device=None,
        res=256,
        subsample=4,
        fov=130.0,
        fps=10.0,
        patience=PATIENCE,
        resample=False,
    ):
        if patience < 1:
            raise ValueError(f"patience must be at least one step, but {patience} was given")
        geometries = (
            sources.sample("homes", min(n_envs, 512), seed=seed)
            if geometries is None
            else geometries
        )
        geometries = geometries if resample else geometries[:n_envs]
        self.core = Core(
            scenery(geometries, n_agents=1, n_envs=n_envs, seed=seed, device=device),
            res,
            fov,
            fps,
            seed=seed,
        )
        self.n_envs, self.device, self.subsample, self.patience = (
            n_envs,
            self.core.device,
            subsample,
            patience,
        )
        self.spawner = modules.RandomSpawns(geometries, self.core, resample=resample)
        self.movement = modules.MomentumMovement(self.core)
        pixels = modules.RGB(self.core, subsample).space.W
        self.obs_space = dotdict(
            rgb=spaces.MultiImage(1, 3, 1, pixels),
            d=spaces.MultiImage(1, 1, 1, pixels),
            imu=spaces.MultiVector(1, 3),
        )
        self.action_space = self.movement.space
        words = -(-self.core.scenery.layouts.max_texels // 32)
        engine.fit(n_envs, 4 * words + 8 * pixels + 64, self.device)
        self.seen = torch.zeros((n_envs, 1, words), dtype=torch.int32, device=self.device)
        self.length = torch.zeros(n_envs, dtype=torch.int32, device=self.device)
        self.left = torch.zeros(
            n_envs, dtype=torch.int32, device=self.device
        )  # steps, if nothing new is seen
        self.ended = torch.zeros(n_envs, dtype=torch.bool, device=self.device)
        self._never = torch.zeros(n_envs, dtype=torch.bool, device=self.device)

    def reset(self):
        """Starts every episode anew. Returns a world."""
        return self._observe(torch.ones_like(self.ended))

    def step(self, decision):
        """One step by ``decision.actions`` (B, 1). Returns a world."""
        self.movement(decision)
        return self._observe(self.ended.clone())

    def _observe(self, reset):
        self.spawner(reset)
        obs, newly_seen = self._look(seen=self.seen, clear_mask=reset[:, None])
        self.length.add_(1).masked_fill_(reset, 0)
        self.left.sub_(1).masked_fill_(reset, self.patience).add_(newly_seen)
        torch.le(self.left, 0, out=self.ended)
        reward = (newly_seen / TEXELS_A_POINT).masked_fill_(reset, 0.0)
        return arrdict(
            obs=obs, reward=reward, reset=reset, terminal=self._never, truncated=self.ended.clone()
        )

    @property
    def n_seen(self):
        """(N,) texels seen in this episode."""
        return self.left - self.patience + self.length

    def _look(self, **seen):
        """The observation, and if ``seen`` is given how many texels were new (N,)."""
        view = engine.observe(self.core.scenery, self.core.agents, self.subsample, imu=True, **seen)
        pictures = {"rgb": view.rgb, "d": view.depth, "imu": view.imu}
        obs = arrdict(
            {
                key: pictures[key].view(self.n_envs, *space.shape)
                for key, space in self.obs_space.items()
            }
        )
        return obs, view.newly_seen[:, 0] if seen else None

    @property
    def layout(self) -> torch.Tensor:
        """(N,) int32: the layout that each environment shows now, an index into ``geometries``."""
        return self.core.scenery.layout

    def state(self, e=0):
        """What :meth:`plot_state` draws of world ``e``."""
        return arrdict(
            core=self.core.state(e),
            obs=self._look()[0][e],
            seen=self._seen_texels(e),
            length=self.length[e].clone(),
            n_seen=self.n_seen[e].clone(),
        )

    def _seen_texels(self, e):
        """(T,) bool: which of the static texels of world ``e`` have been seen in this episode."""
        bits = (
            self.seen[e, 0, :, None] >> torch.arange(32, dtype=torch.int32, device=self.device) & 1
        )
        layouts, d = self.core.scenery.layouts, int(self.core.scenery.layout[e])
        first, last = layouts.texel_starts[layouts.wall_starts[d : d + 2].long()].tolist()
        return bits.flatten()[: last - first].bool()

    @classmethod
    def plot_state(cls, state):
        """A matplotlib figure of a numpyified :meth:`state`: the plan, bright where it has been
        seen, and what the agent sees.
        """
        figure, plan, strips = plotting.panels(
            2, title=f"step {state.length}, {state.n_seen} of {len(state.seen)} texels seen"
        )
        distances = engine.AGENT_RADIUS + 10 * (1 - state.obs.d[0].astype("float32"))
        Core.plot_state(state.core, plan, seen=state.seen, distances=distances)
        plotting.plot_images(
            {"rgb": state.obs.rgb, "depth": state.obs.d}, aspect=plotting.STRIP, axes=strips
        )
        return figure
