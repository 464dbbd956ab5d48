"""The visible texels of each layout, by wall and word, for counts of those that are unseen.

Axes: D layouts, W walls of all layouts together, S runs.
"""

import torch

from megastep.engine.launch_params import texel_bits
from megastep.engine.scenery import Scenery

__all__ = ["TexelRuns"]

WORD = 32  # bits


class TexelRuns:
    """Runs of visible texels. A run is those of one wall that share a word of the bitmap, at most
    1.6 m, and has a midpoint. Counting them needs no walls: neither floor plans nor spawn points
    change during training.

    Args:
        scenery: its layouts' walls are read once, here.
        visible: (D, n_words) int32, from :func:`~megastep.modules.visible_texels`.

    Attributes:
        table: (S, 4) float32, layout after layout: x and y of the midpoint in metres, and the
            memory of two int32: index of the word in its layout's bitmap, and the visible bits.
        starts: (D + 1,) int32, first run of each layout.
        n_visible: (D,) int32, visible texels of each layout.

    Raises:
        TypeError, ValueError: if ``visible`` does not fit.
    """

    IS_STATELESS = True  # it follows from the scenery and `visible`

    def __init__(self, scenery: Scenery, visible: torch.Tensor):
        layouts, device = scenery.layouts, scenery.device
        _, self.n_words = texel_bits(scenery, "visible", visible, (len(layouts),))
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
        self.table = table.contiguous().to(device)
        self.starts = torch.cat([n_runs.new_zeros(1), n_runs.cumsum(0)]).int().to(device)
        self.n_visible = n_visible.int().to(device)

    def addresses(self, scenery: Scenery, n_words: int) -> dict[str, int]:
        """Returns the addresses as ExplorerStepParams names them.

        Raises:
            ValueError: unless they were made for as many layouts and words, on the same device.
        """
        n_layouts = len(self.n_visible)
        if (n_layouts, self.n_words, self.table.device) != (
            len(scenery.layouts),
            n_words,
            scenery.device,
        ):
            raise ValueError(
                f"runs must be of the scenery's {len(scenery.layouts)} layouts of {n_words} words "
                f"on {scenery.device}, but they are of {n_layouts} of {self.n_words} on "
                f"{self.table.device}"
            )
        return dict(
            runs=self.table.data_ptr(),
            run_starts=self.starts.data_ptr(),
            n_visible=self.n_visible.data_ptr(),
        )


def _as_signed(bits) -> torch.Tensor:
    """Returns numbers below 2**32 as the int32 numbers of the same bits."""
    return bits - (bits >> 31 << 32)
