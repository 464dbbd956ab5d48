"""What environments are made of: movement, sensors, spawning, lifespans. Callables with a
``.space`` where there is one to declare.

N worlds, A agents a world, C cameras an agent, R rays, B = N A lanes. A mask of lanes or agents may
be given as (B,) or (N, A).
"""

import numpy as np
import torch

from . import engine, spaces
from .arrdict import arrdict
from .geometry import centers

# Velocity of each action in the agent's frame, and its turn: 0 nothing, 1 left, 2 right, 3 forward,
# 4 back, 5 turn left, 6 turn right.
MOVES = [(0, 0), (0, 1), (0, -1), (1, 0), (-1, 0), (0, 0), (0, 0)]
TURNS = [0, 0, 0, 0, 0, 1, -1]


def to_global(angles, vectors):
    """Vectors (..., 2) of the agents' frames, turned by ``angles`` (...) degrees into the
    world's.
    """
    radians = torch.deg2rad(angles)
    s, c = radians.sin(), radians.cos()
    x, y = vectors[..., 0], vectors[..., 1]
    return torch.stack([c * x - s * y, s * x + c * y], -1)


def to_local(angles, vectors):
    """Vectors (..., 2) of the world's frame, turned into the agents'."""
    return to_global(-angles, vectors)


class _Movement:
    """Seven actions: each adds a velocity once the fraction ``damping`` of the old one is lost."""

    def __init__(self, core, speed, ang_speed, damping):
        self.core, self.damping = core, damping
        self.moves = torch.tensor(
            [(speed * x, speed * y, ang_speed * turn) for (x, y), turn in zip(MOVES, TURNS)],
            dtype=torch.float32,
            device=core.device,
        )
        self.space = spaces.MultiDiscrete(core.n_agents, len(MOVES))

    def __call__(self, decision):
        """Takes ``decision.actions``, ints (B, 1), (N, A) or (B,), moves the agents and returns
        :class:`~megastep.engine.Physics`.
        """
        actions = (
            decision["actions"].reshape(self.core.n_envs, self.core.n_agents).long().contiguous()
        )
        return engine.physics(
            self.core.scenery, self.core.agents, actions, self.moves, self.damping
        )


class SimpleMovement(_Movement):
    """Velocity is what the action says: ``speed`` m/s along an axis of the agent, ``ang_speed``
    deg/s about it, for one step.
    """

    def __init__(self, core, speed=10.0, ang_speed=180.0):
        super().__init__(core, speed, ang_speed, damping=1.0)


class MomentumMovement(_Movement):
    """Actions accelerate: ``accel`` m/s^2 and ``ang_accel`` deg/s^2, against a ``decay`` of both
    velocities by that fraction each step.
    """

    def __init__(self, core, accel=5.0, ang_accel=180.0, decay=0.125):
        super().__init__(core, accel / core.fps, ang_accel / core.fps, damping=decay)


# ---- Sensors ----


def render(core):
    """:func:`~megastep.engine.render` of a core."""
    return engine.render(core.scenery, core.agents)


def downsample(screen, subsample):
    """(..., R) to (..., R / subsample, subsample): neighbouring rays grouped, ready for a mean or a
    minimum over the last axis.
    """
    if subsample < 1 or screen.shape[-1] % subsample:
        raise ValueError(
            f"subsample must divide the {screen.shape[-1]} rays of the screen, but {subsample} "
            f"was given"
        )
    return screen.reshape(*screen.shape[:-1], screen.shape[-1] // subsample, subsample)


class RGB:
    """Colour: float32 (N, A, 3, 1, R / subsample) in linear light, the mean over ``subsample``
    rays. Several cameras an agent become (N, A, 3, C, R / subsample).
    """

    def __init__(self, core, subsample=1):
        self.core, self.subsample = core, subsample
        downsample(torch.empty(core.res), subsample)
        self.space = spaces.MultiImage(
            core.n_agents, 3, len(core.agents.yaws), core.res // subsample
        )

    def __call__(self, r=None):
        r = render(self.core) if r is None else r
        screen = r.screen.reshape(self.core.n_envs, self.core.n_agents, -1, self.core.res, 3)
        return downsample(screen.permute(0, 1, 4, 2, 3), self.subsample).mean(-1)

    def state(self, e=0):
        """What the agents of world ``e`` see now, (A, ...)."""
        return self()[e]


class Depth:
    """Depth: float32 (N, A, 1, C, R / subsample), the mean over ``subsample`` rays of 1 -
    clamp((distance - radius) / max_depth, 0, 1); ``max_depth`` metres.
    """

    def __init__(self, core, subsample=1, max_depth=10.0):
        self.core, self.subsample, self.max_depth = core, subsample, max_depth
        downsample(torch.empty(core.res), subsample)
        self.space = spaces.MultiImage(
            core.n_agents, 1, len(core.agents.yaws), core.res // subsample
        )

    def __call__(self, r=None):
        r = render(self.core) if r is None else r
        distances = r.distances.reshape(self.core.n_envs, self.core.n_agents, 1, -1, self.core.res)
        depth = 1 - ((distances - self.core.agents.radius) / self.max_depth).clamp(0, 1)
        return downsample(depth, self.subsample).mean(-1)

    def state(self, e=0):
        """What the agents of world ``e`` see now, (A, ...)."""
        return self()[e]


class IMU:
    """Inertia: float32 (N, A, 3), angular velocity / 360 and the agent's own velocity, ahead and
    left, / 10.
    """

    def __init__(self, core):
        self.core = core
        self.space = spaces.MultiVector(core.n_agents, 3)

    def __call__(self):
        agents = self.core.agents
        return torch.cat(
            [agents.angvelocity[..., None] / 360, to_local(agents.angles, agents.velocity) / 10], -1
        )

    def state(self, e=0):
        """What the agents of world ``e`` feel now, (A, ...)."""
        return self()[e]


# ---- Random events ----


class RandomStream:
    """Random numbers by lane: the k-th draw of a lane depends on the seed, the lane and k alone, so
    it is the same on every device, captured or not.
    """

    def __init__(self, n_lanes, seed, device):
        self.seed = seed
        self.counts = torch.zeros(n_lanes, dtype=torch.int32, device=device)
        self.values = torch.zeros((n_lanes, 4), device=device)

    def __call__(self, mask):
        """Four uniform numbers in [0, 1) a lane, (B, 4); fresh where ``mask`` (B,) bool, elsewhere
        what was drawn last.
        """
        return engine.uniform(self.counts, mask.reshape(-1), self.seed, self.values)


def _spawn_points(g, n, radius, random):
    """(n, 2) points in the rooms of a geometry, further than ``radius`` from every wall."""
    i, j = (g.masks > 0).nonzero()
    if not len(i):
        raise ValueError(f"geometry {g.id} has no room to spawn in: its masks need cells above 0")
    found = np.empty((0, 2))
    for _ in range(20):
        choice = random.integers(len(i), size=4 * n)
        points = (
            centers(np.stack([i[choice], j[choice]], 1), g.masks.shape, g.res)
            + random.uniform(-0.5, 0.5, (4 * n, 2)) * g.res
        )
        found = np.concatenate([found, points[_clearance(points, g.walls) > radius]])
        if len(found) >= n:
            return found[:n]
    if not len(found):
        raise ValueError(
            f"geometry {g.id} has no point in a room that is {radius:.2f} m from every wall"
        )
    return found[random.integers(len(found), size=n)]


def _clearance(points, walls):
    """(P,) distance of points (P, 2) to the nearest of walls (M, 2, 2)."""
    a, v = walls[None, :, 0], (walls[:, 1] - walls[:, 0])[None]
    offset = points[:, None] - a
    u = np.clip((offset * v).sum(-1) / np.maximum((v * v).sum(-1), 1e-12), 0, 1)
    return np.linalg.norm(offset - u[..., None] * v, axis=-1).min(1)


class RandomSpawns:
    """Puts agents somewhere random in the rooms of their world's layout, at rest, looking anywhere.

    ``n_spawns`` points a layout are found once, 5 cm clear of the collision disc; each respawn
    picks one, and agents of one world have points of their own. With ``resample`` a world whose
    agents all respawn moves to another layout first. ``geometries`` are those the scenery was made
    from.
    """

    def __init__(self, geometries, core, n_spawns=128, resample=False, seed=None):
        self.core, self.resample = core, resample
        self.seed = core.seed if seed is None else seed
        points = [
            _spawn_points(
                g,
                n_spawns,
                engine.AGENT_RADIUS + 0.05,
                np.random.Generator(np.random.Philox([self.seed, d])),
            )
            for d, g in enumerate(geometries[: len(core.scenery.layouts)])
        ]
        self.points = torch.as_tensor(np.stack(points), dtype=torch.float32, device=core.device)
        self.counts = torch.zeros(
            (core.n_envs, core.n_agents), dtype=torch.int32, device=core.device
        )

    def __call__(self, reset):
        """Respawns the agents marked in ``reset``, (N, A) or (B,) bool."""
        reset = reset.reshape(self.core.n_envs, self.core.n_agents)
        engine.spawn(
            self.core.scenery,
            self.core.agents,
            reset,
            self.points,
            self.counts,
            self.seed,
            self.resample,
        )


class RandomLifespans:
    """Ends episodes after a random number of steps, from ``shortest`` to ``longest``. ``lifespans``
    (B,) and ``ages`` (B,) are in steps.
    """

    def __init__(self, core, shortest=128, longest=256, seed=None):
        if not 0 < shortest <= longest:
            raise ValueError(
                f"lifespans need 0 < shortest <= longest steps, but {shortest} and {longest} were "
                f"given"
            )
        self.shortest, self.longest = shortest, longest
        n = core.n_envs * core.n_agents
        self.random = RandomStream(
            n, (core.seed if seed is None else seed) + (1 << 32), core.device
        )
        self.ages = torch.zeros(n, dtype=torch.int32, device=core.device)
        self.lifespans = torch.zeros(n, dtype=torch.int32, device=core.device)

    def begin(self, reset):
        """A new life for the lanes of ``reset`` (B,)."""
        chance = self.random(reset)[:, 0]
        lifespans = self.shortest + (chance * (self.longest - self.shortest + 1)).int()
        self.lifespans.copy_(torch.where(reset, lifespans, self.lifespans))
        self.ages.masked_fill_(reset, 0)

    def __call__(self, reset):
        """One step: lanes of ``reset`` (B,) begin a life, the others age. Returns (B,) bool, who
        has reached the end.
        """
        self.ages.add_(1)
        self.begin(reset)
        return self.ages >= self.lifespans

    def state(self, lane=0):
        return arrdict(age=self.ages[lane].clone(), lifespan=self.lifespans[lane].clone())
