"""Agents that try to pass walls and, when stopped, to get away, on the courses of wall_courses.py.

wall_crossings.py checks the outcome and shares no code with the kernels.

B copies of each of D layouts (environment e shows layout e % D, as in `scene.scenery`), A agents
per environment, W walls of the largest layout. Metres, degrees, seconds.
"""

import math

import torch

from megastep import core, engine, scene
from megastep.modules import MomentumMovement
from tests.helpers.wall_courses import BODY, RADIUS, make_course
from tests.helpers.wall_crossings import crossed, surroundings

PHASE = 16  # steps in which agents keep their targets
MIN_PHASES = 2
ACCEL, DECAY = 5.0, 0.125  # MomentumMovement's defaults: m/s^2, and a fraction per step
TRY = 0.01  # m: distance that a stopped agent tries to get away
LEAVES = 0.001  # m: minimum distance that counts as getting away
# m: a wall this deep within the radius is no rounding error; RADIUS and BODY differ by 1e-4
SUNK = 1e-5
# fps, accel
SETTINGS = [(1, 1), (1, 100), (3, 30), (10, 1), (10, 100), (30, 10), (60, 100)]
SETTINGS += [(200, 1), (200, 100)]


# ---- Walkers ----

COUNTED = "steps", "collisions", "crossings", "sunk"
RECORDED = "x before", "y before", "x after", "y after", "velocity x", "velocity y"
RECORDED += "angle", "action", "step"


class Walk:
    """Agents on one course, at one rate and acceleration, that run into walls and corners in phases
    of 16 steps.

    Before each phase a quarter of them is placed anew. During a phase an agent heads for an end of
    a wall, for a point on one, along one, or anywhere, at up to MomentumMovement's terminal speed.
    If `acting`, it takes MomentumMovement's actions; else its velocity is set.

    Attributes:
        counts: (4,) int64: steps, collisions, crossings, and agents that overlapped no wall when
            placed but have one within their radius when a phase ends (sunk).
        cornered: (D,) agents that are in an acute corner when a phase ends.
        records: (B, D, A, 9), each agent's first crossing.
    """

    def __init__(self, course, scenery, fps, accel, acting, seed):
        self.course, self.fps, self.accel, self.acting, self.seed = course, fps, accel, acting, seed
        self.core = core.Core(scenery, res=1, fps=fps)
        device, walls = self.core.device, course.walls
        self.shape = (scenery.n_envs // len(walls), len(walls), course.n_agents)
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
        """Counts agents that sank into walls or are in corners."""
        _, least, cornered = surroundings(self.positions, self.course.walls)
        self.counts[3] += (self.clear & (least < RADIUS - SUNK)).sum()
        self.cornered += cornered.sum((0, 2))

    def respawn(self, fraction):
        """Places this fraction of the agents anew, at rest."""
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
        """Gives each agent a wall, and a target on it, for a phase."""
        nearest = surroundings(self.positions, self.course.walls)[0]
        some = (self.random() * self.course.counts[:, None]).long()
        wall = torch.where(self.random() < 0.5, nearest, some)
        a, b = self.course.walls[self.layout, wall].unbind(-2)
        along = b - a
        foot = (
            ((self.positions - a) * along).sum(-1) / along.square().sum(-1).clamp(min=1e-12)
        ).clamp(0, 1)
        kind = self.pick(4)  # 0: an end, 1: the closest point, else: anywhere on the wall
        u = torch.where(
            kind == 0, (self.random() < 0.5).float(), torch.where(kind == 1, foot, self.random())
        )
        self.target = a + u[..., None] * along
        sign = 2 * self.pick(2)[..., None] - 1
        slant = self.slants[self.pick(len(self.slants))][..., None]
        self.grazing = sign * along + slant * torch.stack([-along[..., 1], along[..., 0]], -1)
        # 0: anywhere, 1 and 2: along the wall, else: to the target
        self.mode = self.pick(8)[..., None]
        self.speeds = (
            self.speed * torch.where(self.random() < 0.5, 1, 10 ** (-4 * self.random()))[..., None]
        )

    def headings(self):
        """Returns each agent's desired direction (B, D, A, 2), of length 1, or 0 at its target."""
        way = torch.where(self.mode == 0, self.random(2) - 0.5, self.target - self.positions)
        way = torch.where((self.mode == 1) | (self.mode == 2), self.grazing, way)
        return way / way.norm(dim=-1, keepdim=True).clamp(min=1e-30)

    def actions(self, headings):
        """Returns, of the first five actions, the one that moves each agent furthest along its
        heading; a random action for one agent in ten.
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
        """Returns (b, d, a) of at most that many random agents that the last step stopped.
        Synchronises.
        """
        b, d, a = (self.progress < 1).nonzero(as_tuple=True)
        some = torch.randperm(len(b), generator=self.generator, device=b.device)[:most]
        return b[some], d[some], a[some]

    def describe_crossings(self, most=3):
        """Describes the first few crossings, so that each can be repeated on the walls of
        `make_course(name, seed // 1000)`.
        """
        descriptions = []
        for b, d, a in (~self.records[..., 0].isnan()).nonzero()[:most].tolist():
            note = ", ".join(
                f"{name} {x!r}" for name, x in zip(RECORDED, self.records[b, d, a].tolist())
            )
            descriptions.append(f"{self}: copy {b} of layout {d}, agent {a}: {note}")
        return descriptions

    def __str__(self):
        how = "acting" if self.acting else "driven"
        return (
            f"{self.course.name} at {self.fps} fps, {self.accel} times the acceleration, "
            f"{how}, seed {self.seed}"
        )


# ---- Is an agent stuck? ----


def directions(n, device):
    """(n, 2) unit vectors; those along the axes are exact."""
    turn = 2 * math.pi * torch.arange(n, dtype=torch.float64) / n
    vectors = torch.stack([turn.cos(), turn.sin()], -1)
    return torch.where(vectors.abs() < 1e-12, 0, vectors).float().to(device)


def attempts(scenery, fps, positions, layout, agent, headings):
    """Returns how far (K, n) one agent of each environment (K, A, 2) gets by a step of 1 cm in each
    direction of headings (K, n, 2) while the others rest; 0 if physics reports no progress.
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
    copy, who = torch.arange(k * n, device=scenery.device), agent.repeat_interleave(n)
    agents.velocity[copy, who] = headings.reshape(-1, 2) * TRY * fps
    start = agents.positions.clone()
    progress = engine.physics(copies, agents).progress
    way = (agents.positions - start)[copy, who].norm(dim=-1)
    return torch.where(progress[copy, who] > 0, way, 0).view(k, n)


def held_by_geometry(position, others, walls):
    """True if every direction, to half a degree, brings a disc closer to something that it overlaps
    or nearly touches: then it cannot get away. position (2,), others (A - 1, 2), walls (W, 2, 2).
    """
    offset, along = position - walls[:, 0], walls[:, 1] - walls[:, 0]
    u = ((offset * along).sum(-1) / along.square().sum(-1).clamp(min=1e-30)).clamp(0, 1)
    away = torch.cat([offset - u[:, None] * along, (position - others) / 2])
    away = away[away.norm(dim=-1) < BODY + LEAVES]
    angles = torch.atan2(away[:, 1], away[:, 0]).rad2deg().sort().values
    gaps = torch.cat([angles[1:] - angles[:-1], angles[:1] + 360 - angles[-1:]])
    return len(angles) > 1 and gaps.max().item() < 181


def stuck(walk, most):
    """Lets at most that many stopped agents try to get away: in 32 directions and straight back,
    and in 720 if these fail. Returns (number tried, number held by geometry, descriptions of the
    stuck ones).
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
    for part in rest.split(256) if len(rest) else ():
        all_ways = fine.expand(len(part), -1, -1)
        far[part] = attempts(scenery, walk.fps, positions[part], d[part], a[part], all_ways).amax(1)
    n_held, descriptions = 0, []
    for k in rest[far[rest] < LEAVES].tolist():
        everyone = positions[k].double()
        is_self = torch.arange(walk.course.n_agents, device=device) == a[k]
        walls = walk.course.walls[d[k], : int(walk.course.counts[d[k]])].double()
        excusable = walk.course.n_agents > 1 or not walk.clear[b[k], d[k], a[k]]
        if excusable and held_by_geometry(everyone[is_self][0], everyone[~is_self], walls):
            n_held += 1
        else:
            descriptions.append(
                f"{walk}: copy {b[k]} of layout {d[k]}, agent {a[k]}, step {walk.age}: stuck in an "
                f"environment whose agents are at {positions[k].tolist()!r}"
            )
    return len(b), n_held, descriptions


# ---- Runs ----


def run(name, n_steps, n_agents, device="cpu", seed=0, tries=1 << 30):
    """Walks a course with each of the SETTINGS, driven and acting.

    Args:
        name: of the course.
        n_steps: minimum number of agent steps in all.
        n_agents: maximum number of agents at once.
        tries: number of stopped agents that try to get away after each phase.

    Returns:
        A dict: the COUNTED; `tried`, `held`, `stuck`; `cornered`, a list (D,); `descriptions` of
        the first crossings and of stuck agents.
    """
    course = make_course(name, seed, device)
    modes = [(*setting, acting) for setting in SETTINGS for acting in (False, True)]
    n_agents = min(n_agents, n_steps // (len(modes) * PHASE * MIN_PHASES))
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
                tried, held, descriptions = stuck(walk, tries)
                total["tried"], total["held"] = total["tried"] + tried, total["held"] + held
                total["stuck"] += len(descriptions)
                total["descriptions"] += descriptions[:3]
        engine.check(walk.core.agents)
        for key, value in zip(COUNTED, walk.counts.tolist()):
            total[key] += value
        total["cornered"] = [x + y for x, y in zip(total["cornered"], walk.cornered.tolist())]
        total["descriptions"] += walk.describe_crossings()
    return total
