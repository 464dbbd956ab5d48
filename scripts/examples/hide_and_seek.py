"""Measures hide and seek: hiders against seekers in unseen rooms, with what they do to the bodies.

python scripts/examples/hide_and_seek.py --hiders runs/A runner --seekers runs/A untrained hunter
python scripts/examples/hide_and_seek.py --hiders runs/A --seekers hunter --frozen

Prints a row for each hider and seeker, with 95 % intervals over rooms. Players are runs, bots, and
`untrained` (fresh weights). N environments of A agents, K bodies; H x W cells of floor.
"""

import argparse
import itertools
import math
import os
import sys
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # idle threads of PyTorch must not spin
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np
import torch
from scipy import ndimage

from megastep.agents.errors import UserError
from megastep.agents.evaluation import eval_env, playing, statistics
from megastep.agents.evaluation.eval_env import EvalEnv, Player
from megastep.agents.factory import make as factory
from megastep.agents.factory import settings
from megastep.agents.generator import SeededGenerator
from megastep.agents.runs import folders
from megastep.types import optional

CELL = 0.015  # metres
SLOP = 0.005  # metres by which agents and bodies may overlap
LATER = 30  # steps after the preparation, about as many as seekers need to arrive
AROUND = ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
UNTRAINED = "untrained"
COLUMNS = {
    "hidden": "hidden",
    "seen": "seen",
    "box_move": "box moved, m",
    "box_lock": "boxes locked",
    "closed": "closed in",
    "later": "30 steps later",
    "locked_in": "by locked bodies",
    "enters": "closed: entered over a ramp",
    "ramp_lock": "closed: ramp locked",
}


class Floor(NamedTuple):
    """Where agents can stand: the part of the floor that each cell belongs to, (H, W), or 0."""

    parts: np.ndarray
    corner: np.ndarray  # (2,) metres

    def at(self, points: np.ndarray) -> np.ndarray:
        """Returns the part at each point (n, 2) metres, or beside it."""
        column, row = np.floor((points - self.corner) / CELL).astype(int).T
        height, width = self.parts.shape
        near = [
            self.parts[(row + i).clip(0, height - 1), (column + j).clip(0, width - 1)]
            for i, j in AROUND
        ]
        return np.max(near, 0)


def floor_of(walls: np.ndarray, bodies: np.ndarray, radius: float) -> Floor:
    """Returns the parts of a floor between which no agent gets past walls and bodies.

    Two parts are never apart in truth joined: any way of an agent leads over free cells. Parts that
    only a gap up to 3 cm too narrow joins may count as one.

    Args:
        walls: (L, 2, 2) metres, ends.
        bodies: (K, 5): x and y in metres, angle in degrees, half of length and width in metres.
        radius: of agents, in metres.
    """
    ends = walls.astype(float)
    along = ends[:, 1] - ends[:, 0]
    angles = np.degrees(np.arctan2(along[:, 1], along[:, 0]))
    halves = np.linalg.norm(along, axis=1) / 2
    blocks = np.column_stack([ends.mean(1), angles, halves, 0 * halves])
    reach = radius - SLOP - CELL / math.sqrt(2)
    corner = ends.min((0, 1)) - 2 * radius
    width, height = np.ceil((ends.max((0, 1)) + 2 * radius - corner) / CELL).astype(int)
    free = np.ones((height, width), bool)
    for x, y, angle, length, thick in np.concatenate([blocks, bodies.astype(float)]):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        extent = np.array([abs(c) * length + abs(s) * thick, abs(s) * length + abs(c) * thick])
        centre = np.array([x, y]) - corner
        (j, i), (end_j, end_i) = (
            np.floor((centre + sign * (extent + reach)) / CELL).astype(int) for sign in (-1, 1)
        )
        i, j = max(i, 0), max(j, 0)
        part = free[i : end_i + 1, j : end_j + 1]
        dy = ((np.arange(part.shape[0]) + i + 0.5) * CELL - centre[1])[:, None]
        dx = (np.arange(part.shape[1]) + j + 0.5) * CELL - centre[0]
        ahead = (np.abs(c * dx + s * dy) - length).clip(0)
        aside = (np.abs(c * dy - s * dx) - thick).clip(0)
        part &= ahead**2 + aside**2 >= reach**2
    parts: Any = ndimage.label(free, np.ones((3, 3)))
    return Floor(parts[0], corner)


def are_closed_in(floor: Floor, hiders: np.ndarray, seekers: np.ndarray) -> bool:
    """Returns whether no seeker can reach any hider, (n, 2) metres each."""
    parts = floor.at(hiders)
    return bool((parts > 0).all()) and not np.isin(parts, floor.at(seekers)).any()


class Shelters:
    """Where hiders are closed in, and who enters there.

    Attributes, of each environment: (N,) bool whether all hiders are closed in at the end of the
    preparation (`closed`) and `LATER` steps after it (`later`); of those that are at either time,
    likewise if only locked bodies stop seekers (`locked_in`), a ramp is locked by hiders
    (`ramp_lock`), and a seeker entered over a ramp afterwards (`enters`).
    """

    def __init__(self, env: Any):
        self.env, n = env, env.n_envs
        self.closed, self.later, self.locked_in, self.ramp_lock, self.enters = np.zeros(
            (5, n), bool
        )
        self.floors: list[Floor | None] = [None] * n
        self.shelters: list[np.ndarray] = [np.zeros(0)] * n
        lines, objects = env.core.scenery.layouts.lines, env.objects.all
        self.walls = [lines[d].cpu().numpy() for d in range(len(lines))]
        slots = objects.body_objects.long()
        self.shape = objects.widths[slots].cpu().numpy()
        ramp = env.objects.kinds.get("ramp")
        self.is_ramp = np.zeros(len(slots), bool)
        if ramp is not None:
            self.is_ramp[ramp.slots] = True

    def _agents(self) -> tuple[np.ndarray, np.ndarray]:
        positions, is_hider = self.env.core.agents.positions.cpu().numpy(), self.env.is_hider
        return positions[:, is_hider.cpu().numpy()], positions[:, ~is_hider.cpu().numpy()]

    def look(self, at: np.ndarray, closed: np.ndarray) -> None:
        """Writes into `closed` (N,) which of the environments `at` (N,) bool are closed now."""
        o, (hiders, seekers) = self.env.objects.all, self._agents()
        sizes = o.sizes[..., None] * torch.stack([torch.ones_like(o.widths), o.widths], -1)
        records = torch.cat([o.positions, o.angles[..., None], sizes], -1).cpu().numpy()
        slots, is_there = o.body_objects.cpu().numpy(), (o.visible & ~o.open).cpu().numpy()
        locked = ((o.owners == 0) & o.locked).cpu().numpy()
        layout = self.env.layout.cpu().numpy()
        for e in np.flatnonzero(at):
            walls, bodies, is_body = self.walls[layout[e]], records[e][slots], is_there[e][slots]
            floor = floor_of(walls, bodies[is_body], self.env.core.agents.radius)
            closed[e] = are_closed_in(floor, hiders[e], seekers[e])
            if not closed[e]:
                continue
            self.ramp_lock[e] |= (locked[e] & self.is_ramp).any()
            self.floors[e], self.shelters[e] = floor, floor.at(hiders[e])
            of_locked = floor_of(walls, bodies[is_body & locked[e]], self.env.core.agents.radius)
            self.locked_in[e] |= are_closed_in(of_locked, hiders[e], seekers[e])

    @property
    def either(self) -> np.ndarray:
        return self.closed | self.later

    def watch(self) -> None:
        """Looks for seekers that are elevated inside of a shelter."""
        elevated = getattr(self.env.objects.all, "elevated", None)
        if elevated is None:
            return
        is_up = (elevated > 0)[:, ~self.env.is_hider].cpu().numpy()
        _, seekers = self._agents()
        for e in np.flatnonzero(self.either & ~self.enters & is_up.any(1)):
            inside = np.isin(self.floors[e].at(seekers[e][is_up[e]]), self.shelters[e])  # pyright: ignore
            self.enters[e] = inside.any()


@torch.no_grad()
def measure(env: Any, hiders: Any, seekers: Any, seed: int = 1) -> dict[str, np.ndarray]:
    """Plays an episode in each environment. Returns (N,) of each of `COLUMNS`, and `homes`; NaN in
    the last two where hiders were not closed in.
    """
    policy = playing.duel_policy(hiders, seekers, env.is_hider.expand(env.n_envs, -1))
    world, draws = env.reset(), SeededGenerator(seed)
    state, shelters = policy.initial(env.n_envs * env.n_agents, env.device), Shelters(env)
    shelters.look((~env.is_prep).cpu().numpy(), shelters.closed)
    n_seen = torch.zeros(env.n_envs, device=env.device)
    n_played = torch.zeros_like(n_seen)
    metrics: Any = {}
    for _ in range(env.limit):
        was_prep = env.is_prep
        decision, state = policy(world, state, generator=draws.on(world["reset"].device))
        world = env.step(decision)
        shelters.look((was_prep & ~env.is_prep).cpu().numpy(), shelters.closed)
        plays = ~env.is_prep
        shelters.look((plays & (n_played == LATER)).cpu().numpy(), shelters.later)
        shelters.watch()
        n_seen += plays & env.seen[:, env.is_hider].any(1)
        n_played += plays
        metrics = world["metrics"]
    env.check()
    of_env = {key: values.view(env.n_envs, -1)[:, 0] for key, values in metrics.items()}
    found: dict = dict(hidden=of_env["hidden"], seen=n_seen / n_played)
    found |= dict(box_move=of_env["max_box_move_prep"], box_lock=of_env["num_box_lock_prep"])
    found = {key: values.double().cpu().numpy() for key, values in found.items()}
    found |= dict(closed=shelters.closed, later=shelters.later, locked_in=shelters.locked_in)
    for name in ("enters", "ramp_lock"):
        found[name] = np.where(shelters.either, getattr(shelters, name), np.nan)
    return found | dict(homes=env.layout.cpu().numpy())


def row_of(found: dict[str, np.ndarray]) -> list[str]:
    """Returns the cells of a row: means with their intervals."""
    cells = []
    for name in COLUMNS:
        values = found[name].astype(float)
        known = np.isfinite(values)
        if known.any():
            mean, low, high = statistics.interval(values[known], found["homes"][known])
            cells.append(f"{mean:.3f} ({low:.3f} to {high:.3f})")
        else:
            cells.append("none closed")
    return cells


def main(argv=None) -> None:
    parser = argparse.ArgumentParser(description="Measures hide and seek.")
    parser.add_argument("--hiders", nargs="+", required=True, help="runs, untrained, or bots")
    parser.add_argument("--seekers", nargs="+", required=True, help="likewise")
    parser.add_argument("--episodes", type=int, default=1024)
    parser.add_argument("--frozen", action="store_true", help="nobody can move a body")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", default="auto")
    try:
        compare(parser.parse_args(argv))
    except UserError as error:
        parser.error(str(error))


def compare(args: argparse.Namespace) -> None:
    """Prints the table that the words ask for."""
    runs = [n for n in args.hiders + args.seekers if n != UNTRAINED and not eval_env.is_bot(n)]
    if not runs:
        raise UserError("one of --hiders and --seekers must be a run, which says what is played")
    device = factory.make_device(args.device)
    run = folders.load_checkpoint(folders.find(runs[0]), False, device)
    trained = factory.config_of(run)
    if not hasattr(trained.env, "n_hiders"):
        raise UserError(f"{runs[0]} was trained in {trained.env.name}, which is not hide and seek")
    changes = dict(movable=not args.frozen, resample=False, min_prep=None)
    env_settings = settings.changed(trained.env, **changes)
    geometry = settings.changed(trained.geometry, n=args.episodes)
    homes = factory.homes(env_settings, geometry, "test")
    n_agents = optional(factory.make_sample(env_settings, homes, device=device), "n_agents")
    where = EvalEnv(env_settings, homes, args.episodes * n_agents, args.seed, device)
    print(f"{where.env.n_envs:,} episodes in {len(where.homes):,} unseen rooms")
    print("| " + " | ".join(["hiders", "seekers", *COLUMNS.values()]) + " |")
    print("| --- " * (len(COLUMNS) + 2) + "|")

    def player(name) -> Player:
        if name != UNTRAINED:
            return where.players([name], run, False)[0]
        return Player(name, factory.make_policy(trained.agent, where.env, args.seed))

    players = {name: player(name) for name in dict.fromkeys(args.hiders + args.seekers)}
    for hider, seeker in itertools.product(args.hiders, args.seekers):
        policies = where.begin(run, players[hider], players[seeker])
        cells = row_of(measure(where.env, *policies, seed=args.seed))
        print("| " + " | ".join([hider, seeker, *cells]) + " |", flush=True)


if __name__ == "__main__":
    main()
