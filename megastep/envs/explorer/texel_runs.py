"""The visible texels of each layout, by wall and word, for counts of those that are unseen."""

from typing import NamedTuple

import torch

from megastep.engine.scenery import Scenery

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


NO_RUNS = TexelRuns()


def texel_runs(scenery: Scenery, visible: torch.Tensor) -> TexelRuns:
    """Returns the runs of ``visible``, (D, n_words) int32, the texels that
    :func:`~megastep.modules.visible_texels` returns for the D layouts of a scenery.
    """
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
    indices = torch.stack([word, _as_signed(bits)], 1).int()
    table = torch.cat([places, indices.view(torch.float32)], 1)[bits != 0]
    n_runs = layout[bits != 0].bincount(minlength=len(layouts))
    n_visible = torch.zeros(len(layouts), dtype=torch.int64)
    n_bits = torch.as_tensor(sum(bits >> i & 1 for i in range(WORD)))
    n_visible.index_add_(0, layout, n_bits)
    starts = torch.cat([n_runs.new_zeros(1), n_runs.cumsum(0)])
    tensors = table.contiguous(), starts.int(), n_visible.int()
    return TexelRuns(*(tensor.to(device) for tensor in tensors))


def _as_signed(bits) -> torch.Tensor:
    """Returns numbers below 2**32 as the int32 numbers of the same bits."""
    return bits - (bits >> 31 << 32)
