"""No agent passes a wall and none is ever stuck: layouts that make it hard, agents that try, and
checks that share nothing with the kernels.

Axes: B copies of each of D layouts (environment e shows layout e % D, as in `scene.scenery`), A
agents per environment, W walls of the largest layout; a smaller one is filled up with NaN, which
meets nothing. Metres, degrees, seconds.
"""

import math
from dataclasses import dataclass

import numpy as np
import random_scenery
import torch

from megastep import core, engine, scene
from megastep.dotdict import dotdict
from megastep.geometries import sample
from megastep.modules import MomentumMovement

RADIUS = 0.15 / math.sqrt(2)  # m, an agent's
BODY = 1.001 * RADIUS  # m, at which it is stopped
TOUCH = 1.01 * RADIUS  # m, nearer than which it counts as touching
CORNER_COSINE = (
    -0.125
)  # cosine between the headings to two touched walls: they meet at less than 83 degrees
MIN_GAP = (
    1e-4  # m, no agent is placed nearer to a wall: 6 units in the last place of float32 at 200 m
)
PHASE, PHASES = 16, 2  # steps in which agents keep their goals; and the fewest such phases
ACCEL, DECAY = 5.0, 0.125  # MomentumMovement's defaults: m/s^2, and a fraction a step
TRY, LEAVES = (
    0.01,
    0.001,
)  # m: the distance tried from where an agent was stopped, and the least that counts as leaving
# m, deeper than which a wall is within the radius, and no rounding: of the 1e-4 between RADIUS and
# BODY
SUNK = 1e-5
MAX_PAIRS = dict(
    cpu=1 << 16, cuda=1 << 24
)  # agents times walls checked at once: within a core's cache; 128 MB a float64
SETTINGS = [
    (1, 1),
    (1, 100),
    (3, 30),
    (10, 1),
    (10, 100),
    (30, 10),
    (60, 100),
    (200, 1),
    (200, 100),
]  # fps, accel


# ---- Layouts: (W, 2, 2) float64 arrays of walls ----


def turned(walls, degrees):
    """Walls turned counter-clockwise about the origin."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.asarray(walls, float) @ np.array([[c, s], [-s, c]])


def path(corners):
    """The walls from corner to corner."""
    corners = np.asarray(corners, float)
    return np.stack([corners[:-1], corners[1:]], 1)


def enclosed(walls, corner=1.0):
    """The walls, in a room that leaves a metre on all sides and whose lower-left corner is at
    (corner, corner).
    """
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
    """Walls from one point in n directions: as many corners of 360 / n degrees."""
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
    """A room of free-standing walls with all that degenerates: of no length, double, tiny, of 400
    m.
    """
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


def homes(source, n):
    return [enclosed(g.walls) for g in sample(source, n)]


COURSES = {  # name: (layouts from a random stream, agents per environment)
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
}


def clearances(points, walls):
    """(P, W) distances of points (P, 2) from walls (W, 2, 2), float64."""
    along, offset = walls[:, 1] - walls[:, 0], points[:, None] - walls[:, 0]
    u = ((offset * along).sum(-1) / along.square().sum(-1).clamp(min=1e-30)).clamp(0, 1)
    return (offset - u[..., None] * along).norm(dim=-1)


def places(walls, n, random):
    """Where agents are placed: (n, 2) float32 points within the bounds of walls (W, 2, 2), no
    nearer than MIN_GAP to any. Four in ten lie anywhere; the rest at a wall's flank or end: touching
    it to a few units in the last place, overlapping it, or with the centre next to it.
    """
    found, lower, upper = torch.zeros((0, 2)), walls.amin((0, 1)), walls.amax((0, 1))
    while len(found) < n:
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
        found = torch.cat(
            [found, points[inside & (clearances(points.double(), walls).amin(1) > MIN_GAP)]]
        )
    return found[:n]


@dataclass(frozen=True)
class Course:
    """A course's layouts and where agents are placed in them."""

    name: str
    n_agents: int
    geometries: list
    walls: torch.Tensor  # (D, W, 2, 2) float32
    counts: torch.Tensor  # (D,) how many walls each layout has
    spots: torch.Tensor  # (D, P, 2) float32: where agents are placed
    clear: torch.Tensor  # (D, P) bool: where they then overlap no wall


def make_course(name, seed=0, device="cpu", n_spots=512):
    """The course called `name`."""
    make, n_agents = COURSES[name]
    random = random_scenery.RandomStream(seed)
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


# ---- Does a path cross a wall? ----


def cross(ax, ay, bx, by):
    return ax * by - ay * bx


def boxes_meet(p, q, a, b):
    """Whether the bounding boxes of segments pq and ab meet, touching included. Exact in any
    floating type.
    """
    meet = None
    for i in (0, 1):
        here = (torch.minimum(p[i], q[i]) <= torch.maximum(a[i], b[i])) & (
            torch.maximum(p[i], q[i]) >= torch.minimum(a[i], b[i])
        )
        meet = here if meet is None else meet & here
    return meet


def straddles(p, q, a, b):
    """Whether p and q do not both lie strictly on one side of the line through a and b. Float64."""
    ex, ey = b[0] - a[0], b[1] - a[1]
    one, other = cross(ex, ey, p[0] - a[0], p[1] - a[1]), cross(ex, ey, q[0] - a[0], q[1] - a[1])
    return (torch.minimum(one, other) <= 0) & (torch.maximum(one, other) >= 0)


def crossed(before, after, walls, dense=None):
    """Whether the straight paths from before to after (B, D, A, 2) touch any of walls (D, W, 2, 2):
    bool (B, D, A).

    Closed segments meet if their boxes do and each straddles the other's line (true of points and
    of collinear ones too). Boxes are compared in the given type, which is exact, sides in float64.
    The CPU tries only the pairs whose boxes meet, a GPU all of them (`dense`), because their
    number would take a synchronisation.
    """
    dense = before.device.type == "cuda" if dense is None else dense
    rows, check = rows_of(before, walls), _crossed_dense if dense else _crossed_sparse
    return torch.cat([check(p, q, walls) for p, q in zip(before.split(rows), after.split(rows))])


def rows_of(points, walls):
    """How many of the copies of points (B, D, A, 2) to check at once."""
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
    """The nearest wall of each agent at points (B, D, A, 2), how far it is, and whether the agent
    touches two walls that meet at less than 83 degrees, having them on opposite sides: all (B, D,
    A).
    """
    some = (_surroundings(p, walls) for p in points.split(rows_of(points, walls)))
    return tuple(map(torch.cat, zip(*some)))


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


# ---- Walkers ----

COUNTED = "steps", "collisions", "crossings", "sunk"
RECORDED = (
    "x before",
    "y before",
    "x after",
    "y after",
    "velocity x",
    "velocity y",
    "angle",
    "action",
    "step",
)


class Walk:
    """Agents on one course, at one rate and acceleration, that seek walls and corners in phases of
    16 steps.

    Before each phase a quarter of them is placed anew. In a phase an agent heads for an end of a
    wall, for a point of one, along one, or anywhere, at up to the speed that MomentumMovement would
    give it in the end. If `acting` it does so by MomentumMovement's actions, else its velocity is
    written.

    ``counts`` (4,) int64 are of steps, collisions, crossings, and agents that overlapped no wall
    when placed but are nearer than their radius to one when a phase ends. ``cornered`` (D,) counts
    those that then are in an acute corner. ``records`` (B, D, A, 9) describe each agent's first
    crossing.
    """

    def __init__(self, ground, scenery, fps, accel, acting, seed):
        self.course, self.fps, self.accel, self.acting, self.seed = ground, fps, accel, acting, seed
        self.core = core.Core(scenery, res=1, fps=fps)
        device, walls = self.core.device, ground.walls
        self.shape = (scenery.n_envs // len(walls), len(walls), ground.n_agents)
        self.generator = torch.Generator(device).manual_seed(seed)
        self.move = MomentumMovement(self.core, accel=accel * ACCEL)
        self.speed = accel * ACCEL / fps / DECAY
        self.layout = torch.arange(len(walls), device=device)[None, :, None].expand(self.shape)
        self.ahead = torch.tensor(
            [(0, 0), (0, 1), (0, -1), (1, 0), (-1, 0)], dtype=torch.float32, device=device
        )
        self.slants = torch.tensor(
            [0, 1e-7, -1e-7, 1e-5, -1e-5, 1e-3, -1e-3, 0.1, -0.1], device=device
        )
        self.counts = torch.zeros(len(COUNTED), dtype=torch.int64, device=device)
        self.cornered = torch.zeros(len(walls), dtype=torch.int64, device=device)
        self.records = torch.full((*self.shape, len(RECORDED)), math.nan, device=device)
        self.clear = torch.zeros(self.shape, dtype=torch.bool, device=device)
        self.progress = torch.ones(self.shape, device=device)
        self.age = 0

    def random(self, *shape):
        return torch.rand((*self.shape, *shape), generator=self.generator, device=self.core.device)

    def pick(self, n):
        return torch.randint(n, self.shape, generator=self.generator, device=self.core.device)

    @property
    def positions(self):
        return self.core.agents.positions.view(*self.shape, 2)

    def count_places(self):
        """Counts where agents have got to."""
        _, least, cornered = surroundings(self.positions, self.course.walls)
        self.counts[3] += (self.clear & (least < RADIUS - SUNK)).sum()
        self.cornered += cornered.sum((0, 2))

    def respawn(self, fraction):
        """Places that fraction of the agents anew, at rest."""
        agents, again = self.core.agents, self.random() < fraction
        spot = self.pick(self.course.spots.shape[1])
        flat, wide = again.view(agents.angles.shape), again[..., None]
        self.positions.copy_(
            torch.where(wide, self.course.spots[self.layout, spot], self.positions)
        )
        self.clear = torch.where(again, self.course.clear[self.layout, spot], self.clear)
        agents.angles.copy_(
            torch.where(flat, 360 * self.random().view(flat.shape) - 180, agents.angles)
        )
        agents.velocity.masked_fill_(flat[..., None], 0)
        agents.angvelocity.masked_fill_(flat, 0)

    def aim(self):
        """Gives each agent a wall, and a goal there, for a phase."""
        nearest = surroundings(self.positions, self.course.walls)[0]
        some = (self.random() * self.course.counts[:, None]).long()
        wall = torch.where(self.random() < 0.5, nearest, some)
        a, b = self.course.walls[self.layout, wall].unbind(-2)
        along = b - a
        foot = (
            ((self.positions - a) * along).sum(-1) / along.square().sum(-1).clamp(min=1e-12)
        ).clamp(0, 1)
        kind = self.pick(4)  # to an end, to the foot, to anywhere on it, to anywhere on it
        u = torch.where(
            kind == 0, (self.random() < 0.5).float(), torch.where(kind == 1, foot, self.random())
        )
        self.goal = a + u[..., None] * along
        sign, slant = (
            2 * self.pick(2)[..., None] - 1,
            self.slants[self.pick(len(self.slants))][..., None],
        )
        self.grazing = sign * along + slant * torch.stack([-along[..., 1], along[..., 0]], -1)
        self.mode = self.pick(8)[
            ..., None
        ]  # 0: anywhere, 1 and 2: along the wall, else: to the goal
        self.speeds = (
            self.speed * torch.where(self.random() < 0.5, 1, 10 ** (-4 * self.random()))[..., None]
        )

    def headings(self):
        """Where each agent wants to go, (B, D, A, 2) of length 1 or, being there, 0."""
        way = torch.where(self.mode == 0, self.random(2) - 0.5, self.goal - self.positions)
        way = torch.where((self.mode == 1) | (self.mode == 2), self.grazing, way)
        return way / way.norm(dim=-1, keepdim=True).clamp(min=1e-30)

    def actions(self, headings):
        """For each agent the action of the first five that takes it furthest along its way; one in
        ten any.
        """
        radians = torch.deg2rad(self.core.agents.angles.view(self.shape))
        c, s = radians.cos(), radians.sin()
        local = torch.stack(
            [
                c * headings[..., 0] + s * headings[..., 1],
                c * headings[..., 1] - s * headings[..., 0],
            ],
            -1,
        )
        best = (local[..., None, :] * self.ahead).sum(-1).argmax(-1)
        return torch.where(self.random() < 0.1, self.pick(7), best)

    def step(self):
        agents = self.core.agents
        before, angles, headings = self.positions.clone(), agents.angles.clone(), self.headings()
        if self.acting:
            action, velocity = self.actions(headings), agents.velocity.clone()
            progress = self.move(dict(actions=action)).progress
        else:
            action, velocity = self.pick(1) - 1, headings * self.speeds
            agents.velocity.copy_(velocity.view(agents.velocity.shape))
            progress = engine.physics(self.core.scenery, agents).progress
        self.progress, self.way = progress.view(self.shape), headings
        bad = crossed(before, self.positions, self.course.walls)
        self.counts[1] += (progress < 1).sum()
        self.counts[2] += bad.sum()
        self.record(bad, before, velocity.view(before.shape), angles.view(self.shape), action)
        self.counts[0] += progress.numel()
        self.age += 1

    def record(self, bad, before, velocity, angles, action):
        rest = torch.stack([angles, action.float(), torch.full_like(angles, self.age)], -1)
        now = torch.cat([before, self.positions, velocity, rest], -1)
        new = (bad & self.records[..., 0].isnan())[..., None]
        self.records = torch.where(new, now, self.records)

    def phase(self):
        self.respawn(1.0 if self.age == 0 else 0.25)
        self.aim()
        for _ in range(PHASE):
            self.step()
        self.count_places()

    def stopped(self, most):
        """The (b, d, a) of at most that many agents that the last step stopped, at random.
        Synchronises with the device.
        """
        b, d, a = (self.progress < 1).nonzero(as_tuple=True)
        some = torch.randperm(len(b), generator=self.generator, device=b.device)[:most]
        return b[some], d[some], a[some]

    def describe_crossings(self, most=3):
        """Sentences on the first few crossings, from which each can be made again; the walls are
        those of `make_course(name, seed // 1000)`.
        """
        told = []
        for b, d, a in (~self.records[..., 0].isnan()).nonzero()[:most].tolist():
            note = ", ".join(
                f"{name} {x!r}" for name, x in zip(RECORDED, self.records[b, d, a].tolist())
            )
            told.append(f"{self}: copy {b} of layout {d}, agent {a}: {note}")
        return told

    def __str__(self):
        how = "acting" if self.acting else "driven"
        return (
            f"{self.course.name} at {self.fps} fps, {self.accel} times the acceleration, "
            f"{how}, seed {self.seed}"
        )


# ---- Is an agent stuck? ----


def directions(n, device):
    """(n, 2) unit vectors, those along the axes exactly so."""
    turn = 2 * math.pi * torch.arange(n, dtype=torch.float64) / n
    headings = torch.stack([turn.cos(), turn.sin()], -1)
    return torch.where(headings.abs() < 1e-12, 0, headings).float().to(device)


def attempts(scenery, fps, positions, layout, agent, headings):
    """How far (K, n) agent k of each environment (K, A, 2) gets by a step of 1 cm in each direction of
    headings (K, n, 2) while the others rest; 0 if physics says that no progress was made.
    """
    k, n, _ = headings.shape
    copies = engine.Scenery.of_layouts(
        scenery.n_agents,
        scenery.layouts,
        scenery.model,
        scenery.model_texels.diff(),
        layout.repeat_interleave(n),
    )
    agents = engine.Agents(k * n, scenery.n_agents, res=1, fps=fps, device=scenery.device)
    agents.positions.copy_(positions.repeat_interleave(n, 0))
    each, who = torch.arange(k * n, device=scenery.device), agent.repeat_interleave(n)
    agents.velocity[each, who] = headings.reshape(-1, 2) * TRY * fps
    start = agents.positions.clone()
    progress = engine.physics(copies, agents).progress
    way = (agents.positions - start)[each, who].norm(dim=-1)
    return torch.where(progress[each, who] > 0, way, 0).view(k, n)


def held_by_geometry(position, others, walls):
    """Whether all that an agent overlaps or all but touches leaves it no direction, within half a
    degree, that does not bring it nearer to something: then a disc cannot leave. position (2,),
    others (A - 1, 2), walls (W, 2, 2).
    """
    offset, along = position - walls[:, 0], walls[:, 1] - walls[:, 0]
    u = ((offset * along).sum(-1) / along.square().sum(-1).clamp(min=1e-30)).clamp(0, 1)
    away = torch.cat([offset - u[:, None] * along, (position - others) / 2])
    away = away[away.norm(dim=-1) < BODY + LEAVES]
    angles = torch.atan2(away[:, 1], away[:, 0]).rad2deg().sort().values
    gaps = torch.cat([angles[1:] - angles[:-1], angles[:1] + 360 - angles[-1:]])
    return len(angles) > 1 and gaps.max().item() < 181


def stuck(walk, most):
    """Tries to leave with at most that many agents that were stopped: 32 directions and the way
    straight back, and 720 if these fail. Returns (how many were tried, how many of them geometry
    holds, sentences on the others that stay).
    """
    scenery, device = walk.core.scenery, walk.core.device
    b, d, a = walk.stopped(most)
    if not len(b):
        return 0, 0, []
    positions = walk.positions[b, d]
    headings = torch.cat(
        [directions(32, device).expand(len(b), -1, -1), -walk.way[b, d, a][:, None]], 1
    )
    far = attempts(scenery, walk.fps, positions, d, a, headings).amax(1)
    rest, fine = (far < LEAVES).nonzero()[:, 0], directions(720, device)
    for some in rest.split(256):
        all_ways = fine.expand(len(some), -1, -1)
        far[some] = attempts(scenery, walk.fps, positions[some], d[some], a[some], all_ways).amax(1)
    n_held, told = 0, []
    for k in rest[far[rest] < LEAVES].tolist():
        places_of_all, own = (
            positions[k].double(),
            torch.arange(walk.course.n_agents, device=device) == a[k],
        )
        walls = walk.course.walls[d[k], : int(walk.course.counts[d[k]])].double()
        excusable = walk.course.n_agents > 1 or not walk.clear[b[k], d[k], a[k]]
        if excusable and held_by_geometry(places_of_all[own][0], places_of_all[~own], walls):
            n_held += 1
        else:
            told.append(
                f"{walk}: copy {b[k]} of layout {d[k]}, agent {a[k]}, step {walk.age}: stuck in an "
                f"environment whose agents are at {positions[k].tolist()!r}"
            )
    return len(b), n_held, told


# ---- Runs ----


def run(name, n_steps, n_agents, device="cpu", seed=0, tries=1 << 30, report=None):
    """Walks a course for at least n_steps agent-steps in all, with up to n_agents at once, at each
    of the SETTINGS in turn, driven and acting. After each phase up to `tries` of those that were
    stopped try to leave.

    Returns a dict: the COUNTED; `tried`, `held` and `stuck`; `cornered` (D,), a list; and `descriptions`
    of the first crossings and of the stuck. ``report(total)`` is called after each walk.
    """
    course = make_course(name, seed, device)
    modes = [(*setting, acting) for setting in SETTINGS for acting in (False, True)]
    n_agents = min(n_agents, n_steps // (len(modes) * PHASE * PHASES))
    copies = max(n_agents // (len(course.walls) * course.n_agents), 1)
    scenery = scene.scenery(
        course.geometries, course.n_agents, copies * len(course.walls), device=torch.device(device)
    )
    total = dict.fromkeys((*COUNTED, "tried", "held", "stuck"), 0) | dict(
        cornered=len(course.walls) * [0], descriptions=[]
    )
    per_phase = PHASE * scenery.n_envs * course.n_agents
    for i, (fps, accel, acting) in enumerate(modes):
        walk = Walk(course, scenery, fps, accel, acting, 1000 * seed + i)
        for _ in range(math.ceil((n_steps - total["steps"]) / ((len(modes) - i) * per_phase))):
            walk.phase()
            if tries:
                tried, held, told = stuck(walk, tries)
                total["tried"], total["held"] = total["tried"] + tried, total["held"] + held
                total["stuck"], total["descriptions"] = (
                    total["stuck"] + len(told),
                    total["descriptions"] + told[:3],
                )
        engine.check(walk.core.agents)
        for key, value in zip(COUNTED, walk.counts.tolist()):
            total[key] += value
        total["cornered"] = [x + y for x, y in zip(total["cornered"], walk.cornered.tolist())]
        total["descriptions"] += walk.describe_crossings()
        if report:
            report(total)
    return total
