"""Explorer: see as much of a home as possible."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import torch
from pydantic import Field

from megastep import engine, spaces
from megastep.arrdict import arrdict
from megastep.dotdict import dotdict
from megastep.engine.agents import check_on_cpu
from megastep.engine.launch_params import world_params
from megastep.envs.common import step_outputs, world_of
from megastep.envs.explorer.texel_runs import NO_RUNS, texel_runs
from megastep.envs.first_person import FirstPerson, images
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import WARP, launch
from megastep.modules import ENDLESS, TEXELS_PER_POINT, random_ages, visible_texels
from megastep.settings import checked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Explorer"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
N_EPISODE = LIBRARY.constants["N_EPISODE"]  # numbers that a critic sees of an episode
N_BINS = LIBRARY.constants["BANDS"] * LIBRARY.constants["SECTORS"]


class Explorer(FirstPerson):
    """An agent explores a floor plan. New wall texels (5 cm each) that it sees are the reward.

    Observation:
        ``rgb``, ``d`` and ``imu`` of :class:`~megastep.envs.first_person.FirstPerson`.

    Actions:
        Those of :class:`~megastep.envs.first_person.FirstPerson`.

    Reward:
        Number of texels seen for the first time this episode, divided by 64. The first observation
        gives 0.

    Episode end:
        Truncated after ``patience`` + (texels seen) steps, so an agent that finds nothing new times
        out. Texels of the first observation count. Never terminal.

    Metrics:
        ``coverage``: texels seen, divided by the texels that are visible from the spawn points.

    Args:
        patience: an episode is truncated after this many steps plus the texels seen.
        privileged: if True, worlds have ``privileged`` for a critic: ``episode`` (B, 1, 4), steps
            left / 200 and taken, texels seen and left / 1000; ``unseen`` (B, 1, 48), the square
            root of (visible texels not yet seen / 64) within 1.5 m, within 4 m and beyond, in 16
            sectors of 22.5 degrees, the first straight ahead, to the left.
        metrics: if False, worlds have no ``metrics``.
    """

    @checked
    def __init__(
        self,
        *shared: Any,
        patience: Annotated[int, Field(ge=1, le=10**6)] = 200,
        privileged: bool = False,
        metrics: bool = True,
        **options: Any,
    ):
        super().__init__(*shared, **options)
        self.patience, self.has_metrics = patience, metrics
        self.limits = torch.full_like(self.ages, ENDLESS)
        words = -(-self.core.scenery.layouts.max_texels // 32)
        engine.fit(self.n_envs, 4 * words, self.device)
        shape = self.n_envs, 1, words
        self.seen = torch.zeros(shape, dtype=torch.int32, device=self.device)
        self.runs = None
        if metrics or privileged:
            self.visible = visible_texels(self.core.scenery, self.spawner.points)
            self.runs = texel_runs(self.core.scenery, self.visible)
        if privileged:
            self.privileged_space = dotdict(
                episode=spaces.MultiVector(1, N_EPISODE), unseen=spaces.MultiVector(1, N_BINS)
            )

    def desync(self) -> None:
        """Gives every lane a random age, from the seed, so that episodes do not end together."""
        self.ages.copy_(random_ages(self.limits, self.core.seed))

    def _world(self, free=None) -> arrdict:
        self.spawner(self.ended)
        view = self._view(seen=self.seen, clear_mask=self.ended[:, None])
        out = self._judge(view.newly_seen)
        privileged = {name: out[name] for name in ("episode", "unseen") if out[name] is not None}
        return world_of(out, images(view), ["coverage"], **privileged)

    def _judge(self, newly_seen) -> dict:
        """Rewards agents for the texels (N, A) int32 that they have newly seen."""
        core, is_wanted = self.core, self.privileged_space is not None
        critic = dict(episode=N_EPISODE * is_wanted, unseen=N_BINS * is_wanted)
        outputs, n_lanes = step_outputs(self, int(self.has_metrics), {}, critic), len(self.ended)
        launch(
            *(LIBRARY, "explorer_step", self.device, n_lanes * WARP if is_wanted else n_lanes),
            **world_params(core.scenery, core.agents, "positions", "angles"),
            newly_seen=newly_seen,
            seen=self.seen,
            **(self.runs or NO_RUNS)._asdict(),
            ages=self.ages,
            limits=self.limits,
            ended=self.ended,
            **outputs,
            n_words=self.seen.shape[-1],
            patience=self.patience,
            texels_per_point=TEXELS_PER_POINT,
        )
        check_on_cpu(core.agents)
        return outputs

    @property
    def n_seen(self) -> torch.Tensor:
        """(B,) int32: texels seen this episode."""
        return self.limits - self.patience

    def state(self, e: int = 0) -> arrdict:
        """Returns the tensors of environment ``e`` that :meth:`plot_state` draws."""
        everything = torch.full_like(self.seen[e, 0], -1)
        visible = self.visible[self.layout[e]] if self.runs else everything
        return arrdict(
            self._seen_by(e),
            core=self.core.state(e),
            seen=self._texels(self.seen[e, 0], e),
            visible=self._texels(visible, e),
            n_seen=self.n_seen[e].clone(),
            age=self.ages[e].clone(),
        )

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
        return cls._draw(state, f"step {state.age} · {100 * coverage:.0f} % seen", seen=state.seen)
