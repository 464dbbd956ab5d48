"""Small environments for the engine's tests: random ones, optionally with degenerate cases, and
those of the golden data.

Axes: N environments, A agents, M model lines, L lines of all environments (the agents' first in
each), K lights, T texels.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from tests.helpers import twin

GOLDEN = Path(__file__).parents[1] / "data" / "golden" / "original_engine.npz"
CASES = "box_1", "home_1", "home_1_fast", "home_4", "home_4_near"
TEXEL = 0.05  # m
CORNERS = 0.075 * torch.tensor(
    [(-0.5, -1), (0.5, -1), (1, -0.5), (1, 0.5), (0.5, 1), (-0.5, 1), (-1, 0.5), (-1, -0.5)]
)  # m
OCTAGON = torch.stack([CORNERS, CORNERS.roll(-1, 0)], 1)  # the original's model


@dataclass(frozen=True)
class Environments:
    """The parts of N environments, and their agents. All float32."""

    model: torch.Tensor  # (M, 2, 2)
    lines: torch.Tensor  # (L, 2, 2), agents' lines about the origin
    line_widths: torch.Tensor  # (N,)
    lights: torch.Tensor  # (K, 3): x, y, intensity
    light_widths: torch.Tensor  # (N,)
    textures: torch.Tensor  # (T, 3)
    texture_widths: torch.Tensor  # (L,)
    positions: torch.Tensor  # (N, A, 2)
    angles: torch.Tensor  # (N, A)
    velocity: torch.Tensor  # (N, A, 2)
    angvelocity: torch.Tensor  # (N, A)

    @property
    def n_envs(self):
        return len(self.positions)

    @property
    def n_agents(self):
        return self.positions.shape[1]

    def scenery(self, device="cpu"):
        """Returns the Scenery, with a layout for each environment."""
        from megastep.engine import Layouts, Scenery
        from megastep.ragged import Ragged

        n_lines = self.n_agents * len(self.model)
        of_line = torch.arange(self.n_envs).repeat_interleave(self.line_widths)
        within = (
            torch.arange(len(self.lines)) - (self.line_widths.cumsum(0) - self.line_widths)[of_line]
        )
        is_agent = within < n_lines
        is_agent_texel = is_agent.repeat_interleave(self.texture_widths)
        widths = self.texture_widths[is_agent].view(self.n_envs, n_lines)
        layouts = Layouts(
            Ragged(self.lines[~is_agent], self.line_widths - n_lines),
            Ragged(self.textures[~is_agent_texel], self.texture_widths[~is_agent]),
            Ragged(self.lights, self.light_widths),
            self.textures[is_agent_texel].view(self.n_envs, -1, 3),
            device,
        )
        return Scenery(self.n_agents, layouts, self.model, widths[0], torch.arange(self.n_envs))

    def texels(self):
        """(N,): the number of texels of each environment."""
        return torch.stack([w.sum() for w in self.texture_widths.split(self.line_widths.tolist())])

    def one(self, e, dtype=torch.float64):
        """Returns environment e as a dict: model, walls (all lines except agents'), lights,
        textures, widths (texels per line), positions, angles, velocity, angvelocity.
        """
        mine = lambda vals, widths: vals.split(widths.tolist())[e]  # noqa: E731
        state = {
            k: getattr(self, k)[e].to(dtype)
            for k in ("positions", "angles", "velocity", "angvelocity")
        }
        walls = mine(self.lines, self.line_widths)[self.n_agents * len(self.model) :]
        return dict(
            state,
            model=self.model.to(dtype),
            walls=walls.to(dtype),
            lights=mine(self.lights, self.light_widths).to(dtype),
            textures=mine(self.textures, self.texels()).to(dtype),
            widths=mine(self.texture_widths, self.line_widths),
        )


def unplaced(model, n_agents, walls):
    """The lines of environments with these walls, with agents' lines still about the origin."""
    return torch.cat([torch.cat([*n_agents * [model], w]) for w in walls])


def golden(case):
    """Returns a golden case: Environments, settings (res, fov, fps), and the original's outputs,
    named as in the README beside the data.
    """
    with np.load(GOLDEN) as arrays:
        g = {k.split("/")[1]: torch.as_tensor(arrays[k]) for k in arrays if k.split("/")[0] == case}
    _, n_agents, res, fov, fps = g.pop("meta").tolist()
    walls = [
        lines[8 * int(n_agents) :]
        for lines in g["lines_after_render"].split(g["line_widths"].tolist())
    ]
    envs = Environments(
        model=g["model"],
        lines=unplaced(g.pop("model"), int(n_agents), walls),
        line_widths=g.pop("line_widths"),
        lights=g.pop("light_vals"),
        light_widths=g.pop("light_widths"),
        textures=g.pop("texture_vals"),
        texture_widths=g.pop("texture_widths"),
        **{k: g.pop(k) for k in ("positions", "angles", "velocity", "angvelocity")},
    )
    return envs, dict(res=int(res), fov=fov, fps=fps), g


# Random environments


class CounterGenerator:
    """Seeded random numbers, float64."""

    def __init__(self, seed):
        self.generator = torch.Generator().manual_seed(seed)

    def uniform(self, lower, upper, *shape):
        return lower + (upper - lower) * torch.rand(
            shape, generator=self.generator, dtype=torch.float64
        )

    def pick(self, options, *shape):
        picked = torch.randint(len(options), shape, generator=self.generator)
        return torch.as_tensor(options, dtype=torch.float64)[picked]

    def direction(self, *shape):
        turn = self.uniform(0, 2 * math.pi, *shape)
        return torch.stack([turn.cos(), turn.sin()], -1)

    def segments(self, n, lower, upper, size):
        """n segments, centres in a square of `size` and lengths log-uniform in [lower, upper]."""
        half = (
            self.direction(n)
            * (self.uniform(math.log(lower), math.log(upper), n).exp() / 2)[:, None]
        )
        centre = self.uniform(0, size, n, 2)
        return torch.stack([centre - half, centre + half], 1)


def nudged(x, ulps):
    """The float32 `ulps` steps above (or below) x."""
    bits = torch.as_tensor(x, dtype=torch.float32).view(torch.int32) + ulps
    return bits.view(torch.float32).double()


def parallel(random, walls, agents, directions):
    """Walls exactly along a ray: ahead of the agent, behind it, and one through it."""
    p, ray = agents[0], directions[0, 0, random.pick(range(directions.shape[2]), 3).long()]
    return torch.stack(
        [p + near * r + torch.stack([0 * r, r]) for near, r in zip((1, -2, -0.5), ray)]
    )


def zero_length(random, walls, agents, directions):
    """Points: in an agent's path, just beside it, and anywhere."""
    at = torch.stack(
        [
            agents[0] + 0.5 * random.direction(),
            agents[-1] + 0.12 * random.direction(),
            walls.mean((0, 1)),
        ]
    )
    return at[:, None].expand(-1, 2, -1)


def duplicates(random, walls, agents, directions):
    """Exact copies of other walls, and reversed copies."""
    return torch.cat([walls[-4:], walls[-6:-4].flip(1)])


def touching(random, walls, agents, directions):
    """Axis-parallel walls at the contact distance from the first agent, to a few ulps."""
    p, reach = agents[0], twin.INFLATION * twin.RADIUS
    contacts = []
    for side, axis, ulps in ((1, 0, 0), (-1, 0, 1), (1, 1, -1), (-1, 1, 3)):
        wall = torch.stack([p, p])
        wall[:, axis] = nudged(p[axis] + side * reach, ulps)
        wall[:, 1 - axis] += torch.tensor([-0.4, 0.7], dtype=p.dtype)
        contacts.append(wall)
    # two of the four: between all of them, the agent could not move
    return torch.stack(contacts)[torch.randperm(4, generator=random.generator)[:2]]


def pixel_ends(random, walls, agents, directions):
    """Walls whose ends lie on the rays of pixels."""
    rays = directions[-1, 0][random.pick(range(directions.shape[2]), 4, 2).long()]
    return agents[-1] + rays * random.uniform(0.5, 3, 4, 2, 1)


def tiny(random, walls, agents, directions):
    """Walls of 0.01 to 10 mm, close to the agents."""
    centres = agents[random.pick(range(len(agents)), 6).long()] + random.direction(
        6
    ) * random.uniform(0.15, 1, 6, 1)
    return random.segments(6, 1e-5, 1e-2, 1e-9) + centres[:, None]


def long(random, walls, agents, directions):
    """Walls of 100 to 400 m: one close to an agent, one anywhere."""
    along = random.direction(2) * random.uniform(100, 200, 2, 1)
    aside = torch.stack([-along[:, 1], along[:, 0]], -1) / along.norm(dim=-1, keepdim=True)
    middle = torch.stack([agents[0] + 0.3 * aside[0], walls.mean((0, 1)) + 2 * aside[1]])
    return torch.stack([middle - along, middle + 0.7 * along], 1)


DEGENERATE = {
    f.__name__: f for f in (parallel, zero_length, duplicates, touching, pixel_ends, tiny, long)
}
EVERYTHING = (*DEGENERATE, "overlap")  # agents overlapping


def random_walls(random, n, size, origin):
    """A square room and n walls in it: a third of them axis-parallel, as in homes."""
    corners = torch.tensor([(0, 0), (1, 0), (1, 1), (0, 1)], dtype=torch.float64) * size
    walls = random.segments(n, 0.05, size, size)
    upright = walls[: n // 3]
    upright[:, 1, 0] = upright[:, 0, 0]
    return torch.cat([torch.stack([corners, corners.roll(-1, 0)], 1), walls]) + origin


def random_agents(random, n_agents, size, origin, overlap):
    """Positions (A, 2), each agent overlapping the one before it if `overlap`."""
    positions = random.uniform(0.2, size - 0.2, n_agents, 2) + origin
    if overlap:
        for a in range(1, n_agents):
            positions[a] = positions[a - 1] + random.direction() * random.uniform(
                0.05, 2 * twin.RADIUS
            )
    return positions.float().double()


def random_environments(
    seed,
    n_envs=4,
    n_agents=1,
    n_walls=20,
    *,
    size=8.0,
    origin=1.0,
    degenerate=(),
    res=64,
    fov=130.0,
    max_lights=5,
):
    """Returns N random environments: rooms of `size` metres with their corner at (origin, origin),
    and walls.

    Environments differ in their number of lines and lights.

    Args:
        degenerate: names from EVERYTHING, degenerate cases to add.
        res, fov: the camera whose rays the cases 'parallel' and 'pixel_ends' use.
        origin: 190 puts coordinates at 200 m, where float32 is coarse.
    """
    random, lines, lights, agents, angles = CounterGenerator(seed), [], [], [], []
    for _ in range(n_envs):
        positions = random_agents(random, n_agents, size, origin, "overlap" in degenerate)
        facing = random.uniform(-180, 180, n_agents).float().double()
        walls = random_walls(random, n_walls + int(random.pick(range(4))), size, origin)
        directions = twin.rays(facing, [0.0], res, fov)
        extra = [
            DEGENERATE[name](random, walls, positions, directions)
            for name in degenerate
            if name != "overlap"
        ]
        walls = torch.cat([walls, *extra])[
            torch.randperm(len(walls) + sum(map(len, extra)), generator=random.generator)
        ]
        lines.append(unplaced(OCTAGON, n_agents, [walls.float()]))
        n_lights = 1 + int(random.pick(range(max_lights)))
        places = random.uniform(0, size, n_lights, 2) + origin
        lights.append(torch.cat([places, random.uniform(0.2, 2, n_lights, 1)], -1).float())
        agents.append(positions)
        angles.append(facing)
    widths = [((w[:, 1] - w[:, 0]).norm(dim=-1) / TEXEL).ceil().clamp(min=1).int() for w in lines]
    speed = random.pick([0, 0.1, 1, 10, 1000], n_envs, n_agents, 1)  # m/s
    return Environments(
        model=OCTAGON,
        lines=torch.cat(lines),
        line_widths=torch.tensor([len(x) for x in lines], dtype=torch.int32),
        lights=torch.cat(lights),
        light_widths=torch.tensor([len(x) for x in lights], dtype=torch.int32),
        textures=random.uniform(0, 1, int(torch.cat(widths).sum()), 3).float(),
        texture_widths=torch.cat(widths),
        positions=torch.stack(agents).float(),
        angles=torch.stack(angles).float(),
        velocity=(random.direction(n_envs, n_agents) * speed).float(),
        angvelocity=random.uniform(-300, 300, n_envs, n_agents).float(),
    )
