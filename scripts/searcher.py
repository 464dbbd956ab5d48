"""How many pairs of Deathmatch agents can meet in time: a searcher in homes it does not know.

    python scripts/searcher.py --homes 40 --pairs 3

The searcher explores by frontiers (Yamauchi, "A frontier-based approach for autonomous
exploration", 1997): it goes to where the floor that it has seen borders on floor that it has not.
It plays in the real environment, by the seven actions, against the scripted bot. It sees what an
agent sees, knows its pose exactly, and forgets nothing. When everything is seen it begins anew, as
the bot walks about. A pair has met when a ray of either agent's camera hits the other. Prints, per
source of homes, the fraction of pairs that have met by several steps, with 95 % intervals over
homes. Needs SciPy, which `pip install megastep-flatland[sweep]` brings.

What the searcher knows too well: of floor that it has seen, how far the next wall is, and whether
it can be reached. What it does worse than it could: it spends nearly half of its actions on
turning.
"""

import argparse
import sys
from concurrent import futures
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage, sparse
from scipy.sparse import csgraph

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from planner import Grid

from megastep import engine, geometries
from megastep.agents.evaluation.statistics import interval
from megastep.envs.deathmatch import Deathmatch
from megastep.modules.movement import MOVES, TURNS
from megastep.modules.spawning import distances

SOURCES = {
    "generated": ("homes", {}),
    "generated, `density=3`": ("homes", dict(density=3.0)),
    "bench": ("bench", {}),
    "perfect mazes": ("maze", {}),
    "braided mazes": ("maze", dict(braid=1.0)),
}
STEPS = [250, 500, 1000, 2000]
LIMIT = 500  # steps of a duel
CELL = 0.08  # metres; less than an agent's radius, so a free cell and its neighbours see each other
SIGHT = 10.0  # metres to which depth reads
NEAR = 0.2  # metres within which all floor counts as seen
KICK, SPIN, RETAINED = 0.5, 18.0, 0.875  # of MomentumMovement at ten steps per second
AHEAD = np.array([1, 2, 4, 6, 9, 13, 18, 25, 35, 50])  # cells of the path to aim at, if in sight
FITS, CLEAR, WIDE = 0.112, 0.12, 0.17  # metres from a wall: least, kept, and on straight ways
TIGHT, TIGHT_COST = 0.3, 6.0  # metres from a wall that make a path cost more, and how much
SPEED, TURN_RATE = 2.5, 90.0  # m/s and degrees/s, to turn paths and bearings into seconds
REPLAN, CHASE = 3, 10  # steps between plans, and when following the other agent
STILL = 20  # steps without moving, after which the way is taken for blocked
PATIENCE = 10  # steps in addition to twice the time planned, after which a frontier is given up
TOP, TOP_SPIN = 4.0, 144.0  # m/s and degrees/s, the speeds that actions lead to

HORIZON = 0.3  # seconds ahead to turn for
SLACK, OFF = 10.0, 8.0  # degrees off that do not matter; degrees more that weigh as 1 m/s
OPENED = 27  # cells, width of the square in which a frontier's unseen cells are counted


class Home:
    """What is true of a home: its cells, those where an agent fits, and the paths among them."""

    def __init__(self, walls: np.ndarray):
        self.grid = Grid(walls, CELL)
        self.centres = self.grid.origin + CELL * np.stack(
            np.meshgrid(*map(np.arange, self.grid.shape), indexing="ij"), -1
        ).reshape(-1, 2)
        self.room = distances(self.centres, walls).reshape(self.grid.shape)  # metres to a wall
        self.free = self.room > FITS
        tight = 1 + TIGHT_COST * (1 - self.room.ravel() / TIGHT).clip(0)
        starts, stops, lengths = self.grid.edges
        flat = self.free.ravel()
        fits = flat[starts] & flat[stops]
        starts, stops = np.r_[starts[fits], stops[fits]], np.r_[stops[fits], starts[fits]]
        lengths = np.tile(lengths[fits], 2) * tight[stops]
        self.graph = sparse.csr_matrix((lengths, (starts, stops)), 2 * [flat.size])

    def paths(self, known: np.ndarray, start: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns the cost of paths over known cells (X Y,) from a start, and the cells before."""
        graph = self.graph.copy()
        graph.data = np.where(known[graph.indices], graph.data, np.inf)
        return csgraph.dijkstra(graph, indices=start, return_predecessors=True)

    def part_of(self, point: np.ndarray) -> np.ndarray:
        """Returns the free cells (X Y,) that are connected to the one nearest to a point."""
        parts, _ = ndimage.label(self.free)
        return (parts == parts.ravel()[self.nearest(self.free.ravel(), point)]).ravel()

    def nearest(self, cells: np.ndarray, point: np.ndarray) -> int:
        """Returns the cell, of those True in cells (X Y,), that is nearest to a point."""
        cell = self.grid.cell(point)
        if cells[cell]:
            return cell
        among = np.flatnonzero(cells)
        return int(among[((self.centres[among] - point) ** 2).sum(-1).argmin()])


class Searcher:
    """Explores a home by frontiers, or follows the other agent if `knows_all`.

    Attributes:
        remembered: (X Y,) bool, cells seen and not forgotten. Frontiers are their ends.
        known: (X Y,) bool, free cells that were seen, on which paths are planned.
        path: (K, 2) points to walk along, then what to look at.
    """

    def __init__(self, home: Home, position, rule: str, memory: int, knows_all: bool):
        self.home, self.rule, self.memory, self.knows_all = home, rule, memory, knows_all
        self.part = home.part_of(position)
        self.floor = np.flatnonzero(self.part)
        near = ndimage.binary_dilation(self.part.reshape(home.free.shape), iterations=2)
        self.visible = np.flatnonzero(near)  # cells that may come into view
        self.seen_at = np.full(self.part.size, -np.inf)
        self.remembered, self.ever = np.zeros(self.part.size, bool), np.zeros(self.part.size, bool)
        self.known = self.part.copy() if knows_all else self.remembered.copy()
        self.planned, self.step, self.target = -np.inf, 0, -1
        self.deadline, self.avoid, self.still = np.inf, [], 0
        self.path = np.repeat(position[None], 2, 0)

    def look(self, position, angle, depth, slope: float, sight: float) -> None:
        """Marks what is in view. `depth`: (P,), 1 - metres beyond the radius / sight."""
        cells = self.visible if self.memory else self.visible[~self.remembered[self.visible]]
        off = (self.home.centres[cells] - position).astype(np.float32)
        c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
        ahead, left = off @ np.float32([c, s]), off @ np.float32([-s, c])
        away = np.hypot(ahead, left)
        in_view = (ahead > 0) & (np.abs(left) < slope * ahead) & (away < sight)
        pixels = len(depth)
        column = 0.5 * pixels * (1 - left / np.maximum(slope * ahead, 1e-6))
        metres = engine.AGENT_RADIUS + sight * (1 - depth)
        in_view &= away < metres[column.clip(0, pixels - 1).astype(int)]
        in_view |= away < NEAR
        found = cells[in_view]
        self.step += 1
        self.seen_at[found] = self.step
        self.ever[found] = True
        if self.memory:
            self.remembered = self.seen_at > self.step - self.memory
        else:
            self.remembered[found] = True
        if not self.knows_all:
            self.known = (self.remembered if self.memory else self.ever) & self.part

    def frontier(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the known cells that border on an unseen one, (F,), and the latter, (F,)."""
        shape = self.home.free.shape
        known, unseen = self.known.reshape(shape), ~self.remembered.reshape(shape)
        beyond = np.full(shape, -1)
        numbers = np.arange(beyond.size).reshape(shape)
        for axis in (0, 1):
            for shift in (-1, 1):
                there = np.roll(unseen, shift, axis)
                beyond = np.where(there, np.roll(numbers, shift, axis), beyond)
        cells = np.flatnonzero(known & (beyond >= 0))
        return cells, beyond.ravel()[cells]

    def plan(self, position, angle, other) -> None:
        """Chooses where to go, if it is time to."""
        waited = self.step - self.planned
        is_done = self.target < 0 or self.remembered[self.target]
        if self.knows_all:
            if waited >= CHASE:
                self._follow(position, other)
        elif self.step >= self.deadline:  # it does not get there
            self.avoid.append(self.path[-2])
            self._explore(position, angle)
        elif waited >= REPLAN and is_done:
            self._explore(position, angle)

    def bump(self, position, moved: float) -> None:
        """Takes the next cells of the path for blocked, if it has not moved for long."""
        self.still = 0 if moved > 0.01 else self.still + 1
        if self.still >= STILL:
            path, self.still = self.path[:-1], 0
            nearest = ((path - position) ** 2).sum(-1).argmin()
            for point in path[nearest + 1 : nearest + 4]:
                self.part[self.home.grid.cell(point)] = False
            self.known &= self.part
            self.deadline = self.planned = -np.inf

    def _follow(self, position, other):
        target = self.home.nearest(self.part, other)
        start = self.home.nearest(self.known, position)
        _, before = self.home.paths(self.known, start)
        self._walk(before, start, target, other)

    def _explore(self, position, angle):
        if not self.known.any():
            return
        home, start = self.home, self.home.nearest(self.known, position)
        cells, beyond = self.frontier()
        if not len(cells):  # all is seen: forget
            self.remembered[:] = False
            self.seen_at[:] = -np.inf
            self.remembered[start], self.avoid = True, []
            cells, beyond = self.frontier()
        away, before = home.paths(self.known, start)
        reached = np.isfinite(away[cells])
        cells, beyond = cells[reached], beyond[reached]
        if not len(cells):
            return
        off = home.centres[beyond] - position
        turn = np.abs((np.rad2deg(np.arctan2(*off.T[::-1])) - angle + 180) % 360 - 180)
        seconds = away[cells] / SPEED + turn / TURN_RATE + 1
        if self.rule == "nearest":
            score = -seconds
        else:
            unseen = ~self.remembered.reshape(home.free.shape)
            opened = ndimage.uniform_filter(unseen.astype(np.float32), OPENED).ravel()[beyond]
            score = opened / seconds
        for place in self.avoid:
            score -= 1e3 * (((home.centres[cells] - place) ** 2).sum(-1) < 0.1)
        best = score.argmax()
        self.deadline = self.step + PATIENCE + 20 * seconds[best]
        self._walk(before, start, cells[best], home.centres[beyond[best]])
        self.target = int(beyond[best])

    def _walk(self, before, start, target, look):
        cells, cell = [], target
        while cell >= 0 and cell != start:
            cells.append(cell)
            cell = before[cell]
        cells.append(start)
        self.path = np.concatenate([self.home.centres[cells[::-1]], [look]])
        self.planned = self.step


class Search:
    """Plays a searcher in slot 0 of each environment. N environments.

    Args:
        env: Deathmatch with two agents, in which `homes[env.layout]` are the homes.
        rule: which frontier to go to: `gain`, where most opens per second, or `nearest`.
        memory: steps after which it forgets what it saw. 0: never.
        knows_all: it knows the home and where the other agent is, and follows it.
        sight: metres to which it sees floor.
    """

    def __init__(self, env, homes, rule="gain", memory=0, knows_all=False, sight=SIGHT):
        if rule not in ("gain", "nearest"):
            raise ValueError(f"{rule!r} is no rule: gain or nearest")
        self.env, self.sight = env, sight
        self.slope = np.tan(np.deg2rad(env.core.fov / 2))
        layout, positions = env.layout.numpy(), env.core.agents.positions.numpy()
        of = [homes[k] for k in layout]
        self.searchers = [
            Searcher(home, position[0].astype(float), rule, memory, knows_all)
            for home, position in zip(of, positions)
        ]
        self.shape = np.max([home.free.shape for home in of], 0) + 2
        self.room = np.zeros((len(of), *self.shape))
        for e, home in enumerate(of):
            self.room[e, : home.room.shape[0], : home.room.shape[1]] = home.room
        self.origin = np.stack([home.grid.origin for home in of])
        self.before = positions[:, 0].astype(float)
        self.metres = np.zeros(len(of))

    def act(self, depth: np.ndarray, playing: np.ndarray) -> np.ndarray:
        """Returns actions (N,). `depth`: (N, P) of the searchers; `playing`: (N,) bool."""
        agents = self.env.core.agents
        positions, angles = agents.positions.numpy().astype(float), agents.angles.numpy()
        velocity, spin = (getattr(agents, k).numpy()[:, 0] for k in ("velocity", "angvelocity"))
        here, angle = positions[:, 0], angles[:, 0].astype(float)
        moved = np.hypot(*(here - self.before).T)
        self.metres += np.where(playing, moved, 0)
        self.before = here.copy()
        for e in np.flatnonzero(playing):
            searcher = self.searchers[e]
            searcher.look(here[e], angle[e], depth[e], self.slope, self.sight)
            searcher.bump(here[e], moved[e])
            searcher.plan(here[e], angle[e], positions[e, 1])
        aim, gaze = self.aims(here)
        velocity, spin = velocity.astype(float), spin.astype(float)
        velocities, turns = options(angle, velocity, spin)
        error = velocities - towards(aim - here)[:, None]
        cost = np.hypot(*error.transpose(2, 0, 1)) + turn_cost(gaze - here, angle, turns)
        # what coasting on for one or two steps' way would bring too near to a wall
        keep = self.clearance(here[:, None]).clip(engine.AGENT_RADIUS, CLEAR)
        for seconds in (0.1, 0.2):
            short = keep - self.clearance(here[:, None] + seconds * velocities)
            cost += 50 * short.clip(0)
        return cost.argmin(1)

    def clearance(self, points):
        """Returns the metres (N, K) from points (N, K, 2) to the nearest wall, interpolated."""
        place = ((points - self.origin[:, None]) / CELL).clip(0, self.shape - 2)
        low = place.astype(int)
        (x, y), (u, v) = low.transpose(2, 0, 1), (place - low).transpose(2, 0, 1)
        e = np.arange(len(points))[:, None]
        room = self.room
        left = (1 - v) * room[e, x, y] + v * room[e, x, y + 1]
        return (1 - u) * left + u * ((1 - v) * room[e, x + 1, y] + v * room[e, x + 1, y + 1])

    def aims(self, here):
        """Returns the points of the paths to walk to and to look at, (N, 2) each: the furthest
        point, some cells ahead, to which the way is straight and free; and the unseen floor.
        """
        n = len(here)
        points, gaze = np.empty((n, len(AHEAD), 2)), np.empty((n, 2))
        for e, searcher in enumerate(self.searchers):
            path = searcher.path[:-1]
            nearest = ((path - here[e]) ** 2).sum(-1).argmin()
            points[e] = path[np.minimum(nearest + AHEAD, len(path) - 1)]
            gaze[e] = searcher.path[-1]
        share = np.linspace(0, 1, 40)[1:, None]
        line = here[:, None, None] + share * (points - here[:, None])[:, :, None]
        cells = np.rint((line - self.origin[:, None, None]) / CELL).astype(int)
        cells = cells.clip(0, self.shape - 1)
        room = self.room[np.arange(n)[:, None, None], cells[..., 0], cells[..., 1]].min(-1)
        is_free = room > np.where(AHEAD > 2, WIDE, FITS - 0.02)
        furthest = np.where(is_free, np.arange(len(AHEAD)), 0).max(1)
        aim = points[np.arange(n), furthest]
        return aim, gaze

    def glide(self, playing, speed: float) -> None:
        """Moves the searchers along their paths without inertia, while they turn at TOP_SPIN."""
        agents = self.env.core.agents
        here, angles = agents.positions.numpy()[:, 0], agents.angles.numpy()[:, 0]
        for e in np.flatnonzero(playing):
            path, look = self.searchers[e].path[:-1], self.searchers[e].path[-1]
            nearest = ((path - here[e]) ** 2).sum(-1).argmin()
            path = np.concatenate([here[e : e + 1], path[nearest + 1 :]])
            walked = np.append(0, np.hypot(*np.diff(path, axis=0).T).cumsum())
            here[e] = [np.interp(0.1 * speed, walked, along) for along in path.T]
            off = look - here[e]
            turn = (np.rad2deg(np.arctan2(off[1], off[0])) - angles[e] + 180) % 360 - 180
            angles[e] += np.clip(turn, -TOP_SPIN * 0.1, TOP_SPIN * 0.1)
        agents.velocity[:, 0] = 0
        agents.angvelocity[:, 0] = 0


def options(angle, velocity, spin):
    """Returns, for each action, the velocity after it (N, 7, 2) in m/s, and the heading (N, 7) in
    degrees if the agent turned on for HORIZON seconds.
    """
    radians = np.deg2rad(angle)[:, None]
    c, s = np.cos(radians), np.sin(radians)
    moves, turns = KICK * np.array(MOVES, float), SPIN * np.array(TURNS, float)
    kicks = np.stack([c * moves[:, 0] - s * moves[:, 1], s * moves[:, 0] + c * moves[:, 1]], -1)
    return (
        RETAINED * velocity[:, None] + kicks,
        angle[:, None] + (RETAINED * spin[:, None] + turns) * HORIZON,
    )


def towards(offset):
    """Returns the velocity (N, 2) at which to approach a point at an offset (N, 2) in metres."""
    away = np.hypot(*offset.T)[:, None]
    return offset / np.maximum(away, 1e-9) * np.minimum(4 * away, TOP)


def turn_cost(offset, angle, headings):
    """Returns how far headings (N, 7) are from that of an offset (N, 2), in units of m/s."""
    bearing = np.rad2deg(np.arctan2(offset[:, 1], offset[:, 0]))
    off = (np.abs((bearing[:, None] - headings + 180) % 360 - 180) - SLACK).clip(0) / OFF
    return np.where(np.hypot(*offset.T)[:, None] < 0.02, 0, off)


def sees_pixels(rgb: np.ndarray) -> np.ndarray:
    """Returns whether any pixel of images (..., 3, 1, P) shows an agent, as the bot tells it."""
    light, least = rgb.sum(-3), rgb.min(-3)
    return ((least < 0.12 * light) & (light > 0.01)).any((-1, -2))


def play(env, homes, n_steps, player="search", opponent="bot", lasting=0, glides=0.0, **options):
    """Plays one round in every environment. A round ends at the first death or, from step `lasting`
    on, once the player has seen the other within 10 m and as a pixel. A `duel` ends only at a
    death.

    Args:
        player: in slot 0: search; duel, which aims like the bot while it sees another; bot;
            random; still.
        opponent: in slot 1: bot or still.
        glides: m/s; the player moves at this speed and without inertia, if it is not 0.
        options: of Search.

    Returns:
        (N,) each: steps until `met`, `saw` (the player the other), `near` (the same, within 10 m),
        `pixel` (the same, as a pixel shows it) and `decided`, inf if never; whether it `won`;
        `metres` that it walked; and `seen` (N, len(STEPS)), fraction of the floor by each of STEPS,
        nan where the round was over.
    """
    n, generator = env.n_envs, np.random.default_rng(1)
    sight = options.get("sight", SIGHT)
    world, bot = env.reset(), env.bot(env.core.fov)
    state = bot.initial(2 * n)
    search = Search(env, homes, **options) if player in ("search", "duel") else None
    found = {k: np.full(n, np.inf) for k in ("met", "saw", "near", "pixel", "decided")}
    found |= dict(won=np.zeros(n, bool), seen=np.full((n, len(STEPS)), np.nan))
    playing, total = np.ones(n, bool), np.zeros(n)
    before = env.core.agents.positions[:, 0].numpy().copy()
    for step in range(n_steps + 1):
        view = engine.observe(
            env.core.scenery, env.core.agents, env.subsample, rgb=False, agent_ray=True,
            max_depth=sight,
        )  # fmt: skip
        positions, ray = env.core.agents.positions.numpy(), view.agent_ray.numpy() >= 0
        total += playing * np.hypot(*(positions[:, 0] - before).T)
        before = positions[:, 0].copy()
        away = np.hypot(*(positions[:, 0] - positions[:, 1]).T)
        pixel = sees_pixels(world.obs.rgb.float().numpy()[::2, 0])
        events = dict(met=ray.any(1), saw=ray[:, 0], near=ray[:, 0] & (away < 10), pixel=pixel)
        for name, happens in events.items():
            found[name][playing & happens & np.isinf(found[name])] = step
        if search and step in STEPS:
            for e in np.flatnonzero(playing):
                searcher = search.searchers[e]
                found["seen"][e, STEPS.index(step)] = searcher.ever[searcher.floor].mean()
        if player != "duel" and step >= lasting:
            playing &= np.isinf(np.maximum(found["near"], found["pixel"]))
        if not playing.any() or step == n_steps:
            break
        decision, state = bot(world, state)
        actions = decision.actions.numpy().reshape(n, 2)
        if search:
            depth = view.depth.float().numpy()[:, 0].reshape(n, -1)
            own = search.act(depth, playing)
            aims = (state.lost.numpy()[::2] <= 2) & (player == "duel")
            actions[:, 0] = np.where(aims, actions[:, 0], own)
            if glides:
                search.glide(playing, glides)
                actions[:, 0] = 0
        if player == "random":
            actions[:, 0] = generator.integers(len(MOVES), size=n)
        if player == "still":
            actions[:, 0] = 0
        if opponent == "still":
            actions[:, 1] = 0
        world = env.step(dict(actions=torch.as_tensor(actions.reshape(-1, 1))))
        dies = world.terminal.numpy().reshape(n, 2)
        ends = dies.any(1) & playing
        found["decided"][ends] = step + 1
        found["won"][ends] = dies[ends, 1] & ~dies[ends, 0]
        playing &= ~ends
    return found | dict(metres=total)


CASES = {
    "two bots": dict(player="bot"),
    "random actions": dict(player="random"),
    "searcher": dict(lasting=LIMIT, n_steps=max(STEPS)),
    "searcher, the bot stands still": dict(opponent="still"),
    "searcher, the nearest frontier": dict(rule="nearest"),
    "searcher, 110 degrees": dict(fov=110),
    "searcher, 130 degrees": dict(fov=130),
    "searcher, remembers 50 steps": dict(memory=50),
    "searcher, sees walls 5 m away": dict(sight=5.0),
    "searcher, sees walls 30 m away": dict(sight=30.0),
    "searcher without inertia, 1 m/s": dict(glides=1.0),
    "searcher without inertia, 2 m/s": dict(glides=2.0),
    "searcher without inertia, 4 m/s": dict(glides=4.0),
    "walker who knows where the bot is": dict(knows_all=True),
    "duel": dict(player="duel", damage=0.1),
    "duel of two bots": dict(player="bot", damage=0.1, lasting=LIMIT),
}
"""Arguments of `play` and of the environment."""


def results(job: tuple) -> dict:
    """Returns what `play` does, and `homes` (N,). `job`: title of a source, case, homes, pairs."""
    title, case, n_homes, n_pairs = job
    torch.set_num_threads(1)
    (source, options), case = SOURCES[title], dict(CASES[case])
    plans = geometries.sample(source, n_homes, split="test", seed=1, **options)
    homes = [Home(np.asarray(plan["walls"], float)) for plan in plans]
    n_steps = case.pop("n_steps", LIMIT)
    settings = dict(fov=case.pop("fov", 70.0), damage=case.pop("damage", 0.0))
    env = Deathmatch(n_homes * n_pairs, plans, n_agents=2, limit=n_steps + 1, seed=1, **settings)
    return play(env, homes, n_steps, **case) | dict(homes=env.layout.numpy().copy())


def fraction(values, homes) -> str:
    """Returns a mean and its 95 % interval over homes."""
    mean, lower, upper = interval(values, homes)
    return f"{mean:.2f} ({lower:.2f} to {upper:.2f})"


def row(title: str, case: str, found: dict) -> str:
    """Returns a row of the table in Markdown."""
    homes, cells = found["homes"], [title, case]
    steps = [n for n in STEPS if n <= CASES[case].get("n_steps", LIMIT)]
    for n in STEPS:
        cells.append(fraction(found["met"] <= n, homes) if n in steps else "")
    for name in ("saw", "near", "pixel"):
        cells.append(f"{(found[name] <= LIMIT).mean():.2f}")
    seen = found["seen"][:, STEPS.index(LIMIT)]
    cells.append("" if np.isnan(seen).any() else f"{seen.mean():.2f}")
    is_decided, won = np.isfinite(found["decided"]), found["won"].sum()
    cells.append(
        f"{is_decided.mean():.2f}, {won / is_decided.sum():.2f}" if is_decided.any() else ""
    )
    return " | ".join(["", *cells, ""]).strip()


def main(argv: list[str] | None = None) -> None:
    """Prints a table in Markdown, then how often duels are decided by when the agents met."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--homes", type=int, default=40, help="homes per source")
    parser.add_argument("--pairs", type=int, default=3, help="pairs of agents per home")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--sources", nargs="*", default=list(SOURCES), choices=list(SOURCES))
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES))
    arguments = parser.parse_args(argv)
    met = [f"met by step {n}" for n in STEPS]
    heads = ["homes", "who", *met, "player sees", "within 10 m", "as a pixel", "floor seen"]
    heads.append("decided, of these won")
    print(f"| {' | '.join(heads)} |\n|{' --- |' * len(heads)}")
    size, after = (arguments.homes, arguments.pairs), {}
    jobs = [(title, case, *size) for title in arguments.sources for case in arguments.cases]
    with futures.ProcessPoolExecutor(arguments.jobs) as pool:
        for (title, case, *_), found in zip(jobs, pool.map(results, jobs)):
            print(row(title, case, found), flush=True)
            if case.startswith("duel"):
                after.setdefault(case, []).append((found["met"], found["decided"]))
    for case, pairs in after.items():
        print(f"\n{case}: met in step, decided by step {LIMIT}")
        when, decided = (np.concatenate(part) for part in zip(*pairs))
        for first in range(0, LIMIT, 50):
            among = np.isfinite(decided[(when >= first) & (when < first + 50)])
            if len(among):
                print(f"{first} to {first + 49}: {among.mean():.2f} of {len(among)}")


if __name__ == "__main__":
    main()
