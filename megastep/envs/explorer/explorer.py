"""Explorer: see as much of a home as possible. A step is one operation, :func:`explorer_step`.

N environments, A agents each, B = N A lanes. The environment has one agent.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import torch
from pydantic import Field

from megastep import engine, spaces
from megastep.arrdict import arrdict
from megastep.dotdict import dotdict
from megastep.engine import checks
from megastep.engine.agents import Agents, check_on_cpu
from megastep.engine.launch_params import lanes_of, texel_bits, world_params
from megastep.engine.scenery import Scenery
from megastep.envs.common import world_of
from megastep.envs.explorer.texel_runs import TexelRuns
from megastep.envs.first_person import FirstPerson, images
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import WARP, launch
from megastep.modules import ENDLESS, TEXELS_PER_POINT, random_ages, visible_texels
from megastep.settings import checked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Explorer", "ExplorerStep", "explorer_step"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
N_EPISODE = LIBRARY.constants["N_EPISODE"]  # numbers that a critic sees of an episode
N_BINS = LIBRARY.constants["BANDS"] * LIBRARY.constants["SECTORS"]


class ExplorerStep(NamedTuple):
    """The outcome of a step, one row per lane."""

    reward: torch.Tensor  # (B,)
    reset: torch.Tensor  # (B,) bool
    terminal: torch.Tensor  # (B,) bool, always False
    truncated: torch.Tensor  # (B,) bool
    coverage: torch.Tensor | None  # (B,) 0 where no episode ends; None if not wanted, as the next
    episode: torch.Tensor | None  # (B, 1, 4): steps left / 200; steps taken, texels seen and left,
    # each / 1000
    unseen: torch.Tensor | None  # (B, 1, N_BINS): square root of (unseen texels / 64) in each bin:
    # within 1.5 m, within 4 m and beyond, in 16 sectors of 22.5 degrees. Sector 0 is straight
    # ahead, and they run to the left. A run's texels are all counted at its midpoint.


def explorer_step(
    scenery: Scenery,
    agents: Agents,
    newly_seen: torch.Tensor,
    seen: torch.Tensor,
    runs: TexelRuns | None,
    ages: torch.Tensor,
    limits: torch.Tensor,
    ended: torch.Tensor,
    *,
    patience: int = 200,
    coverage: bool = False,
    privileged: bool = False,
) -> ExplorerStep:
    """Rewards each agent for texels that it has seen for the first time, and ends episodes. See
    :class:`~megastep.envs.Explorer`.

    Args:
        newly_seen: (N, A) int32, from :func:`~megastep.engine.observe`.
        seen: (N, A, n_words) int32, the bitmap that it was given.
        runs: the visible texels of the scenery's layouts. None if neither ``coverage`` nor
            ``privileged``.
        ages: (B,) int32, steps since the first observation, updated in place.
        limits: (B,) int32, age at which the episode is truncated, updated in place.
        ended: (B,) bool, updated in place. In: lanes that start an episode in this step. Out: lanes
            whose episode ends in this step.
        patience: an episode is truncated after this many steps plus the texels seen.
        coverage: compute the fraction of the visible texels that was seen, where an episode ends.
        privileged: compute the privileged observation.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
        EngineError: on the CPU, if a position is NaN or a layout does not exist.
    """
    n, a = lanes = lanes_of(scenery, agents)
    device, n_lanes = scenery.device, n * a
    coverage_out = episode = unseen = None
    if checks.flag("coverage", coverage):
        coverage_out = torch.empty(n_lanes, device=device)
    if checks.flag("privileged", privileged):
        episode = torch.empty((n_lanes, 1, N_EPISODE), device=device)
        unseen = torch.empty((n_lanes, 1, N_BINS), device=device)
    flags = [torch.empty(n_lanes, dtype=torch.bool, device=device) for _ in range(3)]
    reward = torch.empty(n_lanes, device=device)
    outputs = dict(coverage=coverage_out, episode=episode, unseen=unseen)
    out = ExplorerStep(reward, *flags, **outputs)
    seen_at, n_words = texel_bits(scenery, "seen", seen, lanes)
    tables = dict(runs=0, run_starts=0, n_visible=0)
    if coverage or privileged:
        tables = checks.instance("runs", runs, TexelRuns).addresses(scenery, n_words)
    launch(
        *(LIBRARY, "explorer_step", device, n_lanes * WARP if privileged else n_lanes),
        **world_params(scenery, agents, "positions", "angles"),
        newly_seen=checks.address("newly_seen", newly_seen, lanes, torch.int32, device),
        seen=seen_at,
        **tables,
        **checks.addresses((n_lanes,), torch.int32, device, ages=ages, limits=limits),
        ended=checks.address("ended", ended, (n_lanes,), torch.bool, device),
        **out._asdict(),
        n_words=n_words,
        patience=checks.integer("patience", patience, 1, 2**31 - 1),
        texels_per_point=TEXELS_PER_POINT,
    )
    check_on_cpu(agents)
    return out


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
            left and taken, texels seen and left; ``unseen`` (B, 1, 48), where around the agent the
            visible texels lie that it has not seen yet.
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
            self.runs = TexelRuns(self.core.scenery, self.visible)
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
        assert view.newly_seen is not None
        step = explorer_step(
            self.core.scenery,
            self.core.agents,
            view.newly_seen,
            self.seen,
            self.runs,
            self.ages,
            self.limits,
            self.ended,
            patience=self.patience,
            coverage=self.has_metrics,
            privileged=self.privileged_space is not None,
        )
        world = world_of(step, images(view))
        if step.coverage is not None:
            world["metrics"] = arrdict(coverage=step.coverage)
        if step.unseen is not None:
            world["privileged"] = arrdict(episode=step.episode, unseen=step.unseen)
        return world

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
