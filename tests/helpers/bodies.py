"""Worlds of agents and movable objects, and how far they overlap, in float64."""

import functools

import torch

from megastep import engine, scene
from megastep.geometries import sample
from megastep.modules.spawning import cached_points

SHAPES = "crate", "crate", "disc", "crate", "crate", "disc"
SIZES = 0.15, 0.2, 0.1, 0.4, 0.3, 0.15  # metres
WIDTHS = 1.0, 0.8, 1.0, 0.2, 0.5, 1.0
MASSES = 1.0, 0.5, 0.3, 2.0, 4.0, 1.0  # kg
MOVES = torch.tensor([(0, 0, 0), (0, 0.5, 0), (0, -0.5, 0), (0.5, 0, 0), (-0.5, 0, 0)] + [
    (0, 0, 18), (0, 0, -18), (0.5, 0, 9), (0.5, 0, -9)
], dtype=torch.float32)  # fmt: skip


def world(n_envs, source="box", n_agents=3, device="cpu", seed=1, friction=0.5, **arguments):
    """Scenery, agents, and objects at random places, of which the last one cannot be moved. The
    source "ramps" is a box with two ramps, and agents that stand before them.
    """
    ramps = source == "ramps"
    plans = sample("box" if ramps else source, 4, seed=seed)
    scenery = scene.scenery(plans, n_agents, n_envs, device=device)
    agents = engine.Agents(n_envs, n_agents, device=device)
    shapes, sizes = [*SHAPES, "crate"], torch.tensor([*SIZES, 0.15], device=device)
    if ramps:
        shapes[:2] = "ramp", "ramp"
        arguments |= dict(n_agents=n_agents, ramp_steps=4)
    movable = [True] * len(SHAPES) + [False]
    objects = engine.Objects(
        n_envs, shapes, [[1.0, 0, 0]], False, None, device, [*WIDTHS, 1.0], movable, **arguments
    )
    scenery.objects = objects
    objects.sizes.copy_(sizes)
    objects.masses.copy_(torch.tensor(MASSES, device=device))
    objects.frictions.fill_(friction)
    objects.solid.fill_(True)
    random = torch.Generator().manual_seed(seed)
    points = cached_points(plans, 256, 1, 0.45, seed)
    points = torch.as_tensor(points, device=device)
    drawn, placed = torch.zeros((n_envs, n_agents), device=device).int(), objects.carriers * 0
    bad = torch.ones(n_envs, dtype=torch.bool, device=device)
    while bad.any():  # agents that spawn on each other are drawn again
        everyone = bad[:, None].expand(-1, n_agents).contiguous()
        engine.spawn(scenery, agents, everyone, points, drawn, seed)
        mask = bad[:, None].expand_as(objects.visible).contiguous()
        engine.place_objects(scenery, agents, mask, points, placed, seed, 0.01)
        if ramps:
            angles = objects.angles[bad, :2]
            radians = angles.cpu().double().deg2rad()  # with the same cosines on any device
            before = torch.stack([radians.cos(), radians.sin()], -1).float().to(device)
            before *= sizes[:2, None] + 0.2
            agents.positions[bad, :2] = objects.positions[bad, :2] - before
            agents.angles[bad, :2] = angles + 10
        bad = (overlaps(scenery, agents) > 0).to(device)
    return scenery, agents, random


@functools.lru_cache(maxsize=4)
def walls_of(scenery):
    """The walls of each environment, as :func:`corners` has them, the last one repeated."""
    walls = [scenery.layouts.lines[int(d)].double().cpu() for d in scenery.layout]
    most = max(map(len, walls))
    walls = torch.stack([torch.cat([w, w[-1:].expand(most - len(w), 2, 2)]) for w in walls])
    along = (walls[:, :, 1] - walls[:, :, 0]) / 2
    return walls.mean(2), torch.stack([along, 0 * along], -2), 0 * along[..., 0]


def corners(scenery, agents):
    """The discs and rectangles of each environment: centres (N, K, 2), axes (N, K, 2, 2) whose
    lengths are half those of the sides, and radii (N, K), 0 of rectangles, in float64.
    """
    o, n = scenery.objects, scenery.n_envs
    sizes, angles = o.sizes.double().cpu(), torch.deg2rad(o.angles.double().cpu())
    is_disc = (o.shapes == 0).cpu().expand(n, -1)
    x = torch.stack([angles.cos(), angles.sin()], -1) * (sizes * ~is_disc)[..., None]
    y = torch.stack([-x[..., 1], x[..., 0]], -1) * o.widths.double().cpu()[:, None]
    bodies = o.positions.double().cpu(), torch.stack([x, y], -2), sizes * is_disc
    of_walls = walls_of(scenery)
    at = agents.positions.double().cpu()
    if o.elevated is not None:  # those who are, or are on a ramp, are far from all else
        far = 1e3 + 1e3 * torch.arange(at.shape[1]).double()
        at = torch.where((o.elevated.cpu() != 0)[..., None], far[:, None], at)
    of_agents = at, torch.zeros(*at.shape, 2).double(), torch.full(at.shape[:2], agents.radius)
    return [torch.cat(parts, 1) for parts in zip(of_agents, bodies, of_walls)]


def overlaps(scenery, agents):
    """(N,) metres, the most that an agent or object of each overlaps another or a wall."""
    centres, axes, radii = corners(scenery, agents)
    n = agents.positions.shape[1] + scenery.objects.n_objects
    extents = axes.square().sum((-1, -2)).sqrt() + radii
    near = torch.cdist(centres[:, :n], centres) < extents[:, :n, None] + extents[:, None]
    env, one, two = near.nonzero().T
    env, one, two = (index[two > one] for index in (env, one, two))
    offset = centres[env, two] - centres[env, one]
    hulls = [(axes[env, k], radii[env, k]) for k in (one, two)]
    depth = torch.full(env.shape, torch.inf, dtype=torch.float64)
    for (own, radius), (other, other_radius), to in zip(hulls, hulls[::-1], (offset, -offset)):
        x, y = own[:, 0], own[:, 1]
        nearest = torch.zeros_like(to)  # of this hull, to the other's centre
        for side in (x, y):
            length = side.norm(dim=-1, keepdim=True)
            unit = side / length.clamp(min=1e-12)
            nearest = nearest + unit * (to * unit).sum(-1, keepdim=True).clamp(-length, length)
        to_disc = torch.where(other_radius[:, None] > 0, to - nearest, 0)
        for direction in (x, torch.stack([-x[:, 1], x[:, 0]], -1), to_disc):
            length = direction.norm(dim=-1)
            unit = direction / length.clamp(min=1e-12)[:, None]
            reach = radius + other_radius
            for axis in (own, other):
                reach = reach + (axis * unit[:, None]).sum(-1).abs().sum(-1)
            found = reach - (to * unit).sum(-1).abs()
            depth = torch.where(length > 1e-9, torch.minimum(depth, found), depth)
    result = torch.full((len(centres),), -1.0, dtype=torch.float64)
    return result.scatter_reduce(0, env, depth, "amax")
