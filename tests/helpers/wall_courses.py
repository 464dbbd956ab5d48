"""Courses: layouts in which it is hard to stay on one side of a wall, and spots to place agents at.

D layouts, W walls of the largest one; others are padded with NaN, which no path crosses. P spots.
Metres, degrees.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch

from megastep.dotdict import dotdict
from megastep.geometries import sample
from tests.helpers import random_scenery

RADIUS = 0.15 / math.sqrt(2)  # m, an agent's
BODY = 1.001 * RADIUS  # m, at which an agent is stopped
# m, minimum distance from a wall to place an agent: 6 units in the last place of float32 at 200 m
MIN_GAP = 1e-4


# ---- Layouts: (W, 2, 2) float64 arrays of walls ----


def turned(walls, degrees):
    """Walls rotated counter-clockwise about the origin."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.asarray(walls, float) @ np.array([[c, s], [-s, c]])


def path(corners):
    """The walls from corner to corner."""
    corners = np.asarray(corners, float)
    return np.stack([corners[:-1], corners[1:]], 1)


def enclosed(walls, corner=1.0):
    """The walls in a room with a margin of 1 m and its lower-left corner at (corner, corner)."""
    walls = np.asarray(walls, float)
    walls = walls - walls.min((0, 1)) + corner + 1
    width, height = walls.max((0, 1)) - corner + 1
    room = path(corner + np.array([(0, 0), (width, 0), (width, height), (0, height), (0, 0)]))
    return np.concatenate([walls, room])


def wedge(degrees, turn, arm=9.0):
    """Two walls that meet at an angle; a disc wedges RADIUS / sin(angle / 2) from their corner."""
    return np.concatenate(
        [turned([[(0, 0), (arm, 0)]], turn + side * degrees / 2) for side in (-1, 1)]
    )


def sliver(degrees, turn, arm=9.0):
    """A closed triangle with two long sides."""
    (a, b), (_, c) = wedge(degrees, turn, arm)
    return path([a, b, c, a])


def spokes(n, turn, arm=3.0):
    """Walls from one point in n directions: n corners of 360 / n degrees."""
    return np.concatenate([turned([[(0, 0), (arm, 0)]], turn + 360 * k / n) for k in range(n)])


def slit(gap, turn, length=3.0):
    """Two walls side by side."""
    return turned([[(0, 0), (length, 0)], [(0, gap), (length, gap)]], turn)


def zigzag(width, degrees, turn, n=8, leg=0.8):
    """A corridor, `width` across its legs, that turns by 180 minus `degrees` n times."""
    half = math.radians(degrees) / 2
    corners = np.array(
        [(k * leg * math.sin(half), k % 2 * leg * math.cos(half)) for k in range(n + 1)]
    )
    aside = np.array([width / math.sin(half), 0])
    return turned(np.concatenate([path(corners), path(corners + aside)]), turn)


def crossing(random, n=9, size=6.0):
    """Long walls through one another."""
    return random.segments(n, 1.0, size, size).numpy()


def fragments(seed):
    """A room with free-standing degenerate walls: of length 0, duplicate, tiny, of 400 m."""
    cases = "parallel", "zero_length", "duplicates", "touching", "pixel_ends", "tiny", "long"
    return (
        random_scenery.random_environments(seed, 1, n_walls=6, size=5.0, degenerate=cases)
        .one(0)["walls"]
        .numpy()
    )


def remote(random):
    """Layouts near (190, 190), where a unit in the last place is 15 micrometres."""
    shapes = [wedge(degrees, random.uniform(0, 360).item(), 6.0) for degrees in (5, 20, 60)]
    return [
        enclosed(walls, 190.0)
        for walls in (*shapes, spokes(7, 10.0), crossing(random), slit(2.1 * BODY, 33.0))
    ]


def homes(source, n, **options):
    return [enclosed(g.walls) for g in sample(source, n, **options)]


COURSES = {  # name: (function of a random generator that returns layouts, agents per environment)
    "box": (lambda random: [g.walls for g in sample("box", 1)], 1),
    "column": (lambda random: [g.walls for g in sample("column", 1)], 4),
    "wedges": (
        lambda random: [
            enclosed(wedge(degrees, random.uniform(0, 360).item()))
            for degrees in (2, 3, 5, 8, 12, 20, 30, 45, 60, 75, 90, 120)
        ],
        1,
    ),
    "slivers": (
        lambda random: [
            enclosed(sliver(degrees, random.uniform(0, 360).item()))
            for degrees in (3, 5, 8, 12, 20, 30, 45, 60)
        ],
        1,
    ),
    "spokes": (
        lambda random: [
            enclosed(spokes(n, random.uniform(0, 90).item())) for n in (4, 5, 7, 8, 12)
        ],
        2,
    ),
    "slits": (
        lambda random: [
            enclosed(slit(gap, turn))
            for turn in (0, 90, *random.uniform(0, 180, 2).tolist())
            for gap in (0.01, 0.2, 2 * BODY + 2e-4, 2 * BODY + 2e-3, 0.25)
        ],
        1,
    ),
    "zigzags": (
        lambda random: [
            enclosed(zigzag(width, degrees, turn))
            for degrees in (30, 60, 90)
            for width, turn in zip((0.23, 0.3), random.uniform(0, 360, 2).tolist())
        ],
        1,
    ),
    "crossing": (lambda random: [enclosed(crossing(random)) for _ in range(8)], 1),
    "fragments": (lambda random: [enclosed(fragments(seed)) for seed in range(8)], 2),
    "remote": (remote, 1),
    "homes": (lambda random: homes("homes", 16), 1),
    "bench": (lambda random: homes("bench", 16), 2),
    "dense homes": (lambda random: homes("homes", 16, density=3.0), 2),
}


def clearances(points, walls):
    """(P, W) distances of points (P, 2) from walls (W, 2, 2), float64."""
    along, offset = walls[:, 1] - walls[:, 0], points[:, None] - walls[:, 0]
    u = ((offset * along).sum(-1) / along.square().sum(-1).clamp(min=1e-30)).clamp(0, 1)
    return (offset - u[..., None] * along).norm(dim=-1)


def places(walls, n, random):
    """Returns spots (n, 2) float32 within the bounds of walls (W, 2, 2), at least MIN_GAP from
    each.

    Four in ten are anywhere. The others are at a wall's flank or end: touching it to a few units in
    the last place, overlapping it, or with the centre next to it.
    """
    spots, lower, upper = torch.zeros((0, 2)), walls.amin((0, 1)), walls.amax((0, 1))
    while len(spots) < n:
        a, b = walls[random.pick(range(len(walls)), n).long()].unbind(1)
        u, aside = random.uniform(-0.5, 1.5, n, 1).clamp(0, 1), random.direction(n)
        normal = torch.stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]], -1)
        normal = (
            normal / normal.norm(dim=-1, keepdim=True).clamp(min=1e-9) * random.pick([-1, 1], n, 1)
        )
        inner = (u > 0) & (u < 1) & (normal.norm(dim=-1, keepdim=True) > 0)
        touching = random.pick([RADIUS, BODY], n, 1) + random.pick(
            [-1e-6, -1e-7, 0, 1e-7, 1e-6], n, 1
        )
        overlapping = 10 ** random.uniform(math.log10(MIN_GAP), math.log10(RADIUS), n, 1)
        distance = torch.where(random.uniform(0, 1, n, 1) < 0.5, touching, overlapping)
        near = a + u * (b - a) + distance * torch.where(inner, normal, aside)
        anywhere = random.uniform(0, 1, n, 2) * (upper - lower) + lower
        points = torch.where(random.uniform(0, 1, n, 1) < 0.4, anywhere, near).float()
        inside = ((points > lower) & (points < upper)).all(-1)
        spots = torch.cat(
            [spots, points[inside & (clearances(points.double(), walls).amin(1) > MIN_GAP)]]
        )
    return spots[:n]


@dataclass(frozen=True)
class Course:
    """A course's layouts, and the spots where agents are placed."""

    name: str
    n_agents: int
    geometries: list
    walls: torch.Tensor  # (D, W, 2, 2) float32
    counts: torch.Tensor  # (D,) number of walls of each layout
    spots: torch.Tensor  # (D, P, 2) float32
    clear: torch.Tensor  # (D, P) bool: spots where an agent overlaps no wall


def make_course(name, seed=0, device="cpu", n_spots=512):
    """Returns the course called `name`."""
    make, n_agents = COURSES[name]
    random = random_scenery.CounterGenerator(seed)
    layouts = [torch.as_tensor(np.float32(walls)) for walls in make(random)]
    walls = torch.full((len(layouts), max(map(len, layouts)), 2, 2), math.nan)
    for d, w in enumerate(layouts):
        walls[d, : len(w)] = w
    spots = [places(w.double(), n_spots, random) for w in layouts]
    clear = [clearances(p.double(), w.double()).amin(1) > BODY for p, w in zip(spots, layouts)]
    geometries = [dotdict(walls=w.numpy(), lights=np.zeros((0, 2))) for w in layouts]
    return Course(
        name,
        n_agents,
        geometries,
        walls.to(device),
        torch.tensor([len(w) for w in layouts], device=device),
        torch.stack(spots).to(device),
        torch.stack(clear).to(device),
    )
