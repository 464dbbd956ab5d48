"""A twin of the step of hide and seek in plain Python, an environment at a time, in float64. Shares
no code with the kernel.

N environments of A agents, hiders first; K bodies.
"""

import cmath
import math

import numpy as np
import torch

from tests.helpers.deathmatch_twins import cuts, is_visible
from tests.helpers.memory_twin import draws

BODY = "positions", "angles", "sizes", "colours"
OF_BODIES = "holders", "owners", "locked", "velocity", "angvelocity", "grabbed"
STATE = "ages", "ended", "placed", "tally", "preps", "n_draws", "seen", "blind"


def snapshot(env):
    """Copies of all that a step changes."""
    objects = env.objects.all
    things = {name: getattr(objects, name).cpu().clone() for name in BODY + OF_BODIES}
    things["at"] = env.core.agents.positions.cpu().clone()
    return things | {name: getattr(env, name).cpu().clone() for name in STATE}


def corners(x, y, degrees, half, narrow):
    """The corners of a rectangle, complex, anticlockwise from its lower left."""
    turn = cmath.rect(1, math.radians(degrees))
    return [
        complex(x, y) + turn * complex(sx * half, sy * narrow)
        for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]


def nearest(point, ring):
    """The point of a filled rectangle that is nearest to a point."""
    sides = [(a, b - a) for a, b in zip(ring, ring[1:] + ring[:1])]
    if all(((point - a) * v.conjugate()).imag >= 0 for a, v in sides):
        return point
    ends = []
    for a, v in sides:
        along = ((point - a) * v.conjugate()).real / abs(v) ** 2
        ends.append(a + v * min(max(along, 0), 1))
    return min(ends, key=lambda end: abs(end - point))


class Twin:
    """Environment ``e`` of a snapshot ``s``, which a step changes in place."""

    def __init__(self, env, s, e):
        self.env, self.e, self.s = env, e, s
        self.mine = {name: tensor[e] for name, tensor in s.items()}
        lines = env.core.scenery.layouts.lines[int(env.layout[e])]
        self.walls = lines.cpu().numpy().astype(float)
        self.degrees = env.core.agents.angles[e].tolist()
        elevated = env.objects.all.elevated
        self.up = [False] * env.n_agents if elevated is None else (elevated[e] > 0).tolist()
        self.n_bodies = len(self.mine["holders"])

    def eye(self, a):
        return complex(*self.mine["at"][a].tolist())

    def in_view(self, a, place):
        away = (place - self.eye(a)) * cmath.rect(1, -math.radians(self.degrees[a]))
        return away == 0 or abs(math.degrees(cmath.phase(away))) <= self.env.core.agents.fov / 2

    def ring(self, k):
        x, y = self.mine["positions"][k].tolist()
        half = float(self.mine["sizes"][k])
        narrow = half * float(self.env.objects.all.widths[k])
        return corners(x, y, float(self.mine["angles"][k]), half, narrow)

    def target(self, a):
        if a in self.mine["holders"].tolist():
            return self.mine["holders"].tolist().index(a)
        eye, best, found = self.eye(a), 0.25, -1
        for k in range(self.n_bodies):
            place = nearest(eye, self.ring(k))
            to = 0.9 * np.array([(place - eye).real, (place - eye).imag])
            start = np.array([eye.real, eye.imag])
            is_free = self.in_view(a, place) and not cuts(self.walls, start, start + to).any()
            if abs(place - eye) < best and is_free:
                best, found = abs(place - eye), k
        return found

    def act(self, a, action):
        k, own, m = self.target(a), int(a >= self.env.n_hiders), self.mine
        if k < 0 or action < 7:
            return "nothing"
        free = not m["locked"][k]
        if action == 7 and m["holders"][k] == a:
            m["holders"][k] = -1
            return "let go"
        if action == 7 and m["holders"][k] < 0 and free and not self.up[a]:
            m["holders"][k], m["grabbed"][k] = a, True
            return "grabbed"
        if action == 8 and free:
            m["locked"][k], m["owners"][k], m["holders"][k] = True, own, -1
            m["velocity"][k], m["angvelocity"][k] = 0, 0
            return "locked"
        if action == 8 and m["owners"][k] == own:
            m["locked"][k], m["owners"][k] = False, -1
            return "unlocked"
        return "refused"

    def begin(self):
        env, m, seed = self.env, self.mine, self.env.seed
        numbers = draws(self.s["n_draws"], seed)[self.e]
        start = env.starts[int(env.layout[self.e]), int(numbers[0] * env.starts.shape[1])].cpu()
        m["at"][:], m["positions"][:] = start[: env.n_agents], start[env.n_agents :]
        m["placed"][:], m["tally"][:] = m["positions"], 0
        low = env.rules["min_prep"]
        m["preps"].fill_(low + int(numbers[1] * (env.prep - low + 1)))
        for k in range(self.n_bodies):
            self.s["n_draws"][self.e] += 1
            m["angles"][k] = 360 * draws(self.s["n_draws"], seed)[self.e, 0] - 180
        self.s["n_draws"][self.e] += 1
        m["velocity"][:], m["angvelocity"][:], m["locked"][:] = 0, 0, False
        m["holders"][:], m["owners"][:] = -1, -1

    def find_seen(self):
        env, sides = self.env, []
        for k in range(self.n_bodies):
            ring = self.ring(k)
            is_ramp = k >= env.rules["n_boxes"] + env.rules["n_long"]  # whose last side is low
            ends = [(a, b) for a, b in zip(ring, ring[1:] + ring[:1])][: 3 if is_ramp else 4]
            sides += [[(a.real, a.imag), (b.real, b.imag)] for a, b in ends]
        walls = np.concatenate([self.walls, np.reshape(sides, (-1, 2, 2))])
        seen = [False] * env.n_agents
        for s in range(env.n_hiders, env.n_agents):
            for h in range(env.n_hiders):
                places = self.mine["at"][s].double().numpy(), self.mine["at"][h].double().numpy()
                if self.in_view(s, self.eye(h)) and is_visible(
                    walls, *places, env.core.agents.radius
                ):
                    seen[s] = seen[h] = True
        return seen

    def measure(self):
        n_boxes = self.env.rules["n_boxes"] + self.env.rules["n_long"]
        moved = (self.mine["positions"] - self.mine["placed"]).norm(dim=-1)
        found = []
        for part in (slice(0, n_boxes), slice(n_boxes, None)):
            found += [max(moved[part].tolist(), default=0), int(self.mine["locked"][part].sum())]
        return found

    def state(self, a, age):
        env, m = self.env, self.mine
        k, own, is_prep = self.target(a), int(a >= env.n_hiders), age < env.prep
        left = (
            (env.prep - age) / env.prep if is_prep else (env.limit - age) / (env.limit - env.prep)
        )
        body = [False] * 5
        if k >= 0:
            holds, owner = int(m["holders"][k]) == a, int(m["owners"][k])
            locks = bool(m["locked"][k] and owner == own), bool(m["locked"][k] and owner != own)
            body = [holds, True, *locks, int(m["holders"][k]) >= 0 and not holds]
        return [not own, is_prep, left, self.up[a], *body]

    def step(self, actions):
        """Returns (outputs by name, what agents did)."""
        env, m, n_hiders = self.env, self.mine, self.env.n_hiders
        reset, before, done = bool(m["ended"][0]), int(m["ages"][0]), []
        if reset:
            self.begin()
        elif actions is not None:
            for a, action in enumerate(actions):
                if a < n_hiders or before >= m["preps"]:
                    done.append(self.act(a, action))
        age = 0 if reset else before + 1
        is_prep, ends = bool(age < m["preps"]), not reset and age >= env.limit
        seen = [False] * env.n_agents if is_prep else self.find_seen()
        is_hidden, phase = not any(seen[:n_hiders]), self.measure()
        if not reset and not is_prep:
            m["tally"][0] += is_hidden
        if not reset and age == m["preps"]:
            m["tally"][1:] = torch.tensor(phase)
        pairs = [value for both in zip(m["tally"][1:].tolist(), phase) for value in both]
        n_played = env.limit - max(int(m["preps"]), 1) + 1
        m["ages"][:], m["ended"][:] = age, ends
        m["seen"][:] = torch.tensor(seen)
        teams = [a >= n_hiders for a in range(env.n_agents)]
        m["blind"][:] = torch.tensor(teams) & is_prep
        n_boxes, n_long = env.rules["n_boxes"], env.rules["n_long"]
        kinds = [(k >= n_boxes) + (k >= n_boxes + n_long) for k in range(self.n_bodies)]
        owners, kinds = m["owners"], torch.tensor(kinds, dtype=torch.int32)
        m["colours"][:] = torch.where(m["locked"], 3 + owners, kinds)
        score = 0 if reset or is_prep else 1 if is_hidden else -1
        metrics = [float(m["tally"][0]) / n_played, *pairs] if ends else [0] * 9
        return dict(
            reward=[score * (-1 if team else 1) for team in teams],
            reset=[reset] * env.n_agents,
            terminal=[ends] * env.n_agents,
            truncated=[False] * env.n_agents,
            metrics=[metrics] * env.n_agents,
            state=[self.state(a, age) for a in range(env.n_agents)],
        ), done


def step(env, actions):
    """Returns (outputs of all lanes, the snapshot after the step, what agents did)."""
    s, rows, done = snapshot(env), [], []
    s["ages"], s["ended"] = (s[name].view(env.n_envs, -1) for name in ("ages", "ended"))
    for e in range(env.n_envs):
        row, acts = Twin(env, s, e).step(None if actions is None else actions[e].tolist())
        rows.append(row)
        done += acts
    outputs = {name: torch.tensor([row[name] for row in rows]).flatten(0, 1) for name in rows[0]}
    return outputs, s, done
