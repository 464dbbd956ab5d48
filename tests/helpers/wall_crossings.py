"""Which paths cross walls, and how close walls are, in float64 and without the kernels.

Axes: B copies of each of D layouts, A agents per environment, W walls of the largest layout.
"""

import math

import torch

from tests.helpers.wall_courses import RADIUS

TOUCH = 1.01 * RADIUS  # m: closer agents count as touching
# maximum cosine between the directions to two touched walls that meet at less than 83 degrees
CORNER_COSINE = -0.125
# agents times walls checked at once: on a CPU they fit into a core's cache, on a GPU into 128 MB
MAX_PAIRS = dict(cpu=1 << 16, cuda=1 << 24)


def cross(ax, ay, bx, by):
    return ax * by - ay * bx


def boxes_meet(p, q, a, b):
    """True where the bounding boxes of segments pq and ab overlap or touch. Exact in any float
    dtype.
    """
    meet = None
    for i in (0, 1):
        here = (torch.minimum(p[i], q[i]) <= torch.maximum(a[i], b[i])) & (
            torch.maximum(p[i], q[i]) >= torch.minimum(a[i], b[i])
        )
        meet = here if meet is None else meet & here
    return meet


def straddles(p, q, a, b):
    """True unless p and q lie strictly on one side of the line through a and b. For float64."""
    ex, ey = b[0] - a[0], b[1] - a[1]
    one, other = cross(ex, ey, p[0] - a[0], p[1] - a[1]), cross(ex, ey, q[0] - a[0], q[1] - a[1])
    return (torch.minimum(one, other) <= 0) & (torch.maximum(one, other) >= 0)


def crossed(before, after, walls, dense=None):
    """Returns (B, D, A) bool: straight paths from before to after (B, D, A, 2) that touch one of
    walls (D, W, 2, 2).

    Closed segments meet if their bounding boxes do and each straddles the other's line, also if
    they are points or collinear. Boxes are compared in the given dtype, which is exact, sides in
    float64. The CPU tests only the pairs whose boxes meet; a GPU tests all (`dense`), since their
    number would need a synchronisation.
    """
    dense = before.device.type == "cuda" if dense is None else dense
    rows, check = rows_of(before, walls), _crossed_dense if dense else _crossed_sparse
    return torch.cat([check(p, q, walls) for p, q in zip(before.split(rows), after.split(rows))])


def rows_of(points, walls):
    """The number of copies, of points (B, D, A, 2), to check at once."""
    return max(
        MAX_PAIRS[points.device.type] // (walls.shape[0] * walls.shape[1] * points.shape[2]), 1
    )


def _ends(p, q, walls):
    return [(x[..., 0, None], x[..., 1, None]) for x in (p, q)] + [
        (walls[:, None, :, i, 0], walls[:, None, :, i, 1]) for i in (0, 1)
    ]


def _crossed_dense(p, q, walls):
    ends = _ends(p.double(), q.double(), walls.double())
    p, q, a, b = ends
    return (boxes_meet(*ends) & straddles(p, q, a, b) & straddles(a, b, p, q)).any(-1)


def _crossed_sparse(p, q, walls):
    i, d, a, w = boxes_meet(*_ends(p, q, walls)).nonzero(as_tuple=True)
    start, end = (x[i, d, a].double().unbind(-1) for x in (p, q))
    one, other = (x.unbind(-1) for x in walls[d, w].double().unbind(1))
    meet = straddles(start, end, one, other) & straddles(one, other, start, end)
    out = torch.zeros(p.shape[:-1], dtype=torch.bool)
    out[i[meet], d[meet], a[meet]] = True
    return out


def surroundings(points, walls):
    """Returns, for agents at points (B, D, A, 2), all (B, D, A): the nearest wall, its distance,
    and if the agent is in an acute corner: between two touched walls that meet at less than 83
    degrees.
    """
    chunks = (_surroundings(p, walls) for p in points.split(rows_of(points, walls)))
    return tuple(map(torch.cat, zip(*chunks)))


def _surroundings(points, walls):
    start, along = walls[:, None, :, 0], (walls[:, :, 1] - walls[:, :, 0])[:, None]
    offset = points[..., None, :] - start
    u = ((offset * along).sum(-1) / along.square().sum(-1).clamp(min=1e-30)).clamp(0, 1)
    normal = offset - u[..., None] * along
    distance = normal.norm(dim=-1).nan_to_num(nan=math.inf)
    least, nearest = distance.min(-1)
    first = normal.gather(-2, nearest[..., None, None].expand(*nearest.shape, 1, 2))
    cosine = (normal * first).sum(-1) / (distance * least[..., None]).clamp(min=1e-12)
    return nearest, least, ((distance < TOUCH) & (cosine < CORNER_COSINE)).any(-1) & (least < TOUCH)
