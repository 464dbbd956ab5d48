"""A twin of Explorer's step in plain PyTorch, an operation at a time. Shares no code with the
kernel.

N environments, A agents, B = N A lanes, D layouts, T texels.
"""

import torch
from torch.nn.functional import one_hot

from tests.helpers.texels import n_texels, unpacked

UNITS = torch.tensor([200.0, 1000.0, 1000.0, 1000.0])
SLACK = 2e-5  # of 1 + d metres: float32's resolution at 200 m, and rounded sines and tangents
BANDS = 1.5, 4.0  # m, the ends of the first two of three
SECTOR = 22.5  # degrees; the first of 16 is centred on the agent's heading
AROUND = torch.cartesian_prod(*2 * [torch.tensor([-1.0, 0.0, 1.0])])


def explorer_step(scenery, newly_seen, seen, visible, ages, limits, ended, *, patience=200):
    """Returns {name: tensor} of all outputs of a step of `megastep.envs.Explorer` but
    ``unseen``, and of the new ``ages``, ``limits`` and ``ended``, on the CPU. Changes nothing.
    """
    newly_seen, ages, limits, reset = (x.cpu() for x in (newly_seen, ages, limits, ended))
    limits = limits.masked_fill(reset, patience) + newly_seen.flatten()
    ages = (ages + 1).masked_fill(reset, 0)
    truncated = ages >= limits
    shown = shown_to(scenery, visible)
    n_left = (shown & ~unpacked(seen)).sum(-1).flatten().int()
    n_shown = shown.sum(-1).expand(-1, scenery.n_agents).flatten()
    columns = torch.stack([limits - ages, ages, limits - patience, n_left], -1)
    return dict(
        reward=(newly_seen.flatten() / 64).masked_fill(reset, 0.0),
        reset=reset,
        terminal=torch.zeros_like(reset),
        truncated=truncated,
        coverage=((n_shown - n_left) / n_shown.clamp(min=1)).masked_fill(~truncated, 0.0),
        episode=columns[:, None] / UNITS,
        ages=ages,
        limits=limits,
        ended=truncated,
    )


def shown_to(scenery, visible):
    """(N, 1, T): the visible texels of each environment's layout."""
    visible = unpacked(visible)
    inside = torch.arange(visible.shape[1]) < n_texels(scenery.layouts)[:, None]
    return (visible & inside)[scenery.layout.cpu().long()][:, None]


def check_unseen(scenery, agents, seen, visible, unseen):
    """Checks the step's ``unseen``: every count is within the twin's bounds, and no texel is
    missing. Returns the fraction of texels whose bin is certain.
    """
    left, layouts = shown_to(scenery, visible) & ~unpacked(seen), scenery.layouts
    counts = (64 * unseen.cpu().double().square()).round()
    assert torch.equal((counts / 64).sqrt().float(), unseen.cpu())
    counts = counts.view(*left.shape[:2], 3 * 16)
    assert torch.equal(counts.sum(-1), left.sum(-1).double())
    n_certain = 0
    for e, d in enumerate(scenery.layout.tolist()):
        first, end = layouts.wall_starts[d : d + 2].tolist()
        walls = layouts.lines.vals[first:end].cpu().double()
        widths = layouts.texel_starts[first : end + 1].diff().cpu()
        poses = agents.positions[e].cpu().double(), agents.angles[e].cpu()
        least, most = bounds(walls, widths, left[e], *poses)
        assert bool(((counts[e] >= least) & (counts[e] <= most)).all()), f"environment {e}"
        n_certain += int(least.sum())
    return n_certain / max(int(left.sum()), 1)


def bounds(walls, widths, left, positions, angles):
    """Bounds on the number of texels in each bin: (least, most), each (A, 48), band by band.

    `left` (A, T) bool are the texels to count, wall by wall; `widths` are their numbers per wall
    (W, 2, 2). 32 successive texels share a word. Texels of one wall that share a word are counted
    at the midpoint of all the wall's texels in that word. Every bin within reach of its possible
    error, SLACK, counts towards the upper bound.
    """
    wall = torch.arange(len(walls)).repeat_interleave(widths)
    texel = torch.arange(len(wall))
    along = (texel - (widths.cumsum(0) - widths)[wall] + 0.5).double() / widths[wall]
    (wall, _), run, sizes = torch.stack([wall, texel // 32]).unique(
        dim=1, return_inverse=True, return_counts=True
    )
    middle = torch.zeros(len(sizes), dtype=torch.double).index_add(0, run, along) / sizes
    n_left = torch.zeros((len(left), len(sizes)), dtype=torch.long)
    n_left.index_add_(1, run, left[:, : len(texel)].long())
    starts, ends = walls[wall].unbind(1)
    offsets = starts + middle[:, None] * (ends - starts) - positions[:, None]
    reach = SLACK * (1 + offsets.norm(dim=-1))
    around = offsets[:, :, None] + reach[..., None, None] * AROUND
    bearing = around[..., 1].atan2(around[..., 0]).rad2deg() - angles[:, None, None]
    band = sum((around.norm(dim=-1) > end).long() for end in BANDS)
    bins = one_hot(16 * band + (bearing / SECTOR).round().long() % 16, 3 * 16)
    return [(n_left[..., None] * some).sum(1) for some in (bins.amin(2), bins.amax(2))]
