"""Explorer: see as much of a home as possible. D layouts, S runs of texels."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import torch
from pydantic import Field

from megastep import engine, spaces
from megastep.arrdict import arrdict
from megastep.dotdict import dotdict
from megastep.engine.scenery import Scenery
from megastep.envs.common import judged, world_of
from megastep.envs.first_person import FirstPerson, images
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import WARP
from megastep.modules import ENDLESS, TEXELS_PER_POINT, random_ages, visible_texels
from megastep.settings import checked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Explorer"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
N_EPISODE = LIBRARY.constants["N_EPISODE"]  # numbers that a critic sees of an episode
N_BINS = LIBRARY.constants["BANDS"] * LIBRARY.constants["SECTORS"]
WORD = 32  # bits


class TexelRuns(NamedTuple):
    """Runs of visible texels, layout after layout. A run is those of one wall that share a word of
    the bitmap, at most 1.6 m, and has a midpoint. Counting them needs no walls: neither floor plans
    nor spawn points change during training.
    """

    IS_STATELESS = True  # it follows from the scenery and the visible texels

    #: (S, 4) float32: x and y of the midpoint in metres, and the memory of two int32: index of the
    #: word in its layout's bitmap, and the visible bits
    runs: torch.Tensor | None = None
    run_starts: torch.Tensor | None = None  # (D + 1,) int32, first run of each layout
    n_visible: torch.Tensor | None = None  # (D,) int32, visible texels of each layout
    n_runs: int = 0  # S


NO_RUNS = TexelRuns()


def texel_runs(scenery: Scenery, visible: torch.Tensor) -> TexelRuns:
    """Returns the runs of ``visible``, (D, n_words) int32, see ``modules.visible_texels``."""
    layouts, device = scenery.layouts, scenery.device
    wall_starts, texel_starts = layouts.wall_starts.long().cpu(), layouts.texel_starts.cpu()
    visible, lines = visible.cpu(), layouts.lines.vals.cpu()
    layout = torch.arange(len(layouts)).repeat_interleave(wall_starts.diff())  # (W,)
    first_of_layout = texel_starts[wall_starts[:-1]][layout]
    first, end = texel_starts[:-1] - first_of_layout, texel_starts[1:] - first_of_layout
    first_word = first // WORD
    n_words = torch.where(end > first, (end - 1) // WORD - first_word + 1, 0)
    wall = torch.arange(len(lines)).repeat_interleave(n_words)  # (S,)
    words_before = n_words.cumsum(0) - n_words
    word = (first_word[wall] + torch.arange(len(wall)) - words_before[wall]).long()
    layout, first, end, lines = layout[wall], first[wall], end[wall], lines[wall]
    begin, stop = first.maximum(WORD * word), end.minimum(WORD * word + WORD)
    of_wall = (1 << stop - WORD * word) - (1 << begin - WORD * word)  # int64
    bits = visible[layout, word] & of_wall
    middle = (0.5 * (begin + stop).float() - first.float()) / (end - first).float()
    places = lines[:, 0] + middle[:, None] * (lines[:, 1] - lines[:, 0])
    signed = bits - (bits >> 31 << 32)  # as int32 numbers of the same bits
    indices = torch.stack([word, signed], 1).int()
    table = torch.cat([places, indices.view(torch.float32)], 1)[bits != 0]
    n_runs = layout[bits != 0].bincount(minlength=len(layouts))
    n_visible = torch.zeros(len(layouts), dtype=torch.int64)
    n_bits = torch.as_tensor(sum(bits >> i & 1 for i in range(WORD)))
    n_visible.index_add_(0, layout, n_bits)
    starts = torch.cat([n_runs.new_zeros(1), n_runs.cumsum(0)])
    runs, starts, n_visible = (
        tensor.to(device) for tensor in (table.contiguous(), starts.int(), n_visible.int())
    )
    return TexelRuns(runs, starts, n_visible, len(table))


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

    begins_in_place = True

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
        self.spawner(self._begins)
        view = self._view(seen=self.seen, clear_mask=self._begins[:, None])
        out = self._judge(view.newly_seen)
        return world_of(out, images(view), ["coverage"], episode="episode", unseen="unseen")

    def _judge(self, newly_seen) -> dict:
        """Rewards agents for the texels (N, A) int32 that they have newly seen."""
        n_lanes = len(self.ended)
        return judged(
            *(self, LIBRARY, "explorer_step", int(self.has_metrics)),
            *({}, dict(episode=N_EPISODE, unseen=N_BINS)),
            n_threads=n_lanes if self.privileged_space is None else n_lanes * WARP,
            newly_seen=newly_seen,
            seen=self.seen,
            **(self.runs or NO_RUNS)._asdict(),
            limits=self.limits,
            n_words=self.seen.shape[-1],
            patience=self.patience,
            points_per_texel=1 / TEXELS_PER_POINT,
        )

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
        """Draws a numpyified :meth:`state`: the floor plan, unseen walls grey, above the images."""
        coverage = (state.seen & state.visible).sum() / max(state.visible.sum(), 1)
        return cls._draw(state, f"step {state.age} · {100 * coverage:.0f} % seen", seen=state.seen)
