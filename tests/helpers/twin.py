"""The engine's twin by brute force: every ray against every line, every texel and light, every disc
and obstacle.

Plain PyTorch, one environment at a time, in the dtype and on the device of its arguments (the tests
use float64). It shares no code with the kernels. It is not fast; read it beside the Concepts page
of the original megastep.

Axes: A agents, C cameras, R pixels, L lines (the agents' first), W walls (static lines), K lights,
P points, T texels. Units: metres, degrees, seconds. A line is its two ends, (2, 2). A light is (x,
y, intensity).
"""

import math

import torch

# m, the disc around a square agent 0.15 m wide: its body, and the near limit of its camera
RADIUS = 0.15 / math.sqrt(2)
INFLATION = 1.001  # of the radius in collisions, so that a stopped agent does not touch
SHORTFALL = 0.99  # fraction of the path to a contact that is travelled
AMBIENT = 0.1  # light without any lamp
SHADOW_LIMIT = 0.999  # a line further along the path from light to texel is the texel's own line
DOT_GUARD = 1e-6  # m, keeps the dot of a very short line finite


def cross(a, b):
    """The z part of a x b for vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def turn(vectors, degrees):
    """Vectors (..., 2) turned counter-clockwise by degrees (...)."""
    radians = torch.deg2rad(degrees)
    cosine, sine, (x, y) = radians.cos(), radians.sin(), vectors.unbind(-1)
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y], -1)


def wrapped(degrees):
    """The same angle in [-180, 180)."""
    turned = (degrees + 180) % 360 - 180
    return torch.where(
        turned < 180, turned, -180
    )  # a tiny negative angle's remainder rounds up to 360


# Light


def agent_lines(model, positions, angles):
    """The model (M, 2, 2) at the agents' poses: (A M, 2, 2), agent by agent."""
    return (turn(model[None], angles[:, None, None]) + positions[:, None, None]).flatten(0, 1)


def texel_positions(lines, widths):
    """Centres (T, 2) of the texels. Texel k of w is at the fraction (k + 1/2) / w of its line."""
    centres = [
        ((torch.arange(int(w), device=lines.device) + 0.5) / int(w)).to(lines) for w in widths
    ]
    return torch.cat(
        [lines.new_zeros((0, 2)), *(a + f[:, None] * (b - a) for (a, b), f in zip(lines, centres))]
    )


def light_at(points, walls, lights, slack=0.0, chunk=2**20):
    """Light (P,) in [0.1, 1] at points (P, 2): ambient, plus 2 I / max(d^2, 1) of each light that
    no wall occludes.
    """
    levels = []
    for some in points.split(max(chunk // max(len(walls), 1), 1)):
        level = torch.full_like(some[:, 0], AMBIENT)
        for light in lights:
            shadow = occluded(some - light[:2], walls - light[:2], slack).any(-1)
            level += torch.where(
                shadow, 0, 2 * light[2] / (some - light[:2]).square().sum(-1).clamp(min=1)
            )
        levels.append(level.clamp(max=1))
    return torch.cat(levels) if levels else points.new_zeros(0)


def occluded(ways, walls, slack=0.0):
    """(P, W): walls that cross the path (P, 2) from a light at 0 to a point, before 0.999 of it.

    A wall crosses if its ends are on different sides. With `slack` metres, walls this close to
    crossing count too; with negative slack, only those that cross with this margin. Both together
    bracket the truth for slightly different inputs.
    """
    along, area = walls[:, 1] - walls[:, 0], cross(ways[:, None], walls[:, 1] - walls[:, 0])
    reach = ways.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    sides = [cross(ways[:, None], end) / reach for end in walls.unbind(1)]
    crosses = (torch.minimum(*sides) <= slack) & (torch.maximum(*sides) >= -slack)
    crosses &= (area != 0) | (slack > 0) & (along.norm(dim=-1) > 0)
    size = area.abs().clamp(min=1e-12)
    place = cross(walls[:, 0], along) / torch.copysign(size, area)
    spare = slack * (1 / reach + along.norm(dim=-1) / size)
    return crosses & (place > -spare) & (place < SHADOW_LIMIT + spare)


def bake(walls, lights, points):
    """The light of static texels: the same law as for agents' texels."""
    return light_at(points, walls, lights)


# Raycasting


def rays(angles, cameras, res, fov):
    """Ray directions (A, C, R, 2), one unit ahead of the camera. Pixel 0 is the leftmost."""
    pixel = torch.arange(res, dtype=angles.dtype, device=angles.device)
    sideways = math.tan(math.radians(fov) / 2) * (res - 2 * pixel - 1) / res
    yaws = angles[:, None] + torch.as_tensor(cameras, dtype=angles.dtype, device=angles.device)
    return turn(torch.stack([torch.ones_like(sideways), sideways], -1), yaws[..., None])


def raycast(lines, positions, directions, radius=RADIUS):
    """The nearest line beyond the radius along each ray: indices, locations, dots, distances, each
    (A, C, R).

    A ray meets a line at s = cross(a, v) / cross(ray, v), where v is the line and a its start
    relative to the agent. Distances are in metres. Of lines at the same distance, the lowest index
    is hit; parallel and zero-length lines never are. Agents do not see themselves, as their own
    lines are within the radius.
    """
    along, ray = lines[:, 1] - lines[:, 0], directions[..., None, :]
    start = (lines[:, 0] - positions[:, None])[:, None, None]
    area = cross(ray, along)
    meets = area != 0
    area = torch.where(meets, area, 1)
    location = cross(start, ray) / area
    distance = cross(start, along) / area * ray.norm(dim=-1)
    seen = meets & (location >= 0) & (location <= 1) & (distance > radius)
    distance = torch.where(seen, distance, math.inf)
    nearest = distance.min(-1).values
    index = (distance == nearest[..., None]).int().argmax(-1)  # the first of equals
    hit = nearest < math.inf
    along = along[index]
    dot = (directions * along).sum(-1) / (directions.norm(dim=-1) * along.norm(dim=-1) + DOT_GUARD)
    location = location.gather(-1, index[..., None])[..., 0]
    return dict(
        indices=torch.where(hit, index, -1),
        locations=torch.where(hit, location, math.nan),
        dots=torch.where(hit, dot, math.nan),
        distances=nearest,
    )


def filtered(values, width, start, location):
    """Interpolates values (T, D) linearly between texel centres, clamped at the ends of the line,
    which has `width` texels from `start` on.
    """
    place = torch.minimum((location * width - 0.5).clamp(min=0), (width - 1).to(location))
    left = place.floor().long()
    right = torch.minimum(left + 1, width - 1)
    weight = (place - left)[..., None]
    return (1 - weight) * values[start + left] + weight * values[start + right]


def shade(hits, textures, widths, light):
    """Colours (A, C, R, 3) of hits: filtered texture (T, 3) x filtered light (T,) x (1 - dot^2).
    Misses are black.
    """
    hit, line = hits["indices"] >= 0, hits["indices"].clamp(min=0).long()
    width, start = widths.long()[line], (widths.cumsum(0) - widths).long()[line]
    location, dot = (torch.where(hit, hits[k], 0) for k in ("locations", "dots"))
    colour = filtered(textures, width, start, location) * filtered(
        light[:, None], width, start, location
    )
    return torch.where(hit[..., None], colour * (1 - dot.square())[..., None], 0)


def render(
    model,
    walls,
    lights,
    textures,
    widths,
    positions,
    angles,
    *,
    res=64,
    fov=130.0,
    cameras=(0.0,),
    radius=RADIUS,
):
    """Returns the fields of `cuda.render` for one environment, its `lines` (L, 2, 2) and the
    `light` (T,) of every texel.
    """
    lines = torch.cat([agent_lines(model, positions, angles), walls])
    light = light_at(texel_positions(lines, widths), walls, lights)
    hits = raycast(lines, positions, rays(angles, cameras, res, fov), radius)
    return dict(hits, screen=shade(hits, textures, widths, light), lines=lines, light=light)


# Physics


def contact(offset, step, radius, slack=0.0):
    """The fraction (...) of `step` at which a point at `offset` (..., 2) comes within `radius` of
    0; inf if never. If it is within the radius already: 0 if it approaches, else inf.
    """
    speed, inward = step.square().sum(-1), -(offset * step).sum(-1)
    outside = offset.square().sum(-1) - radius**2
    root = inward.square() - speed * outside
    enters = (outside > 0) & (inward > 0) & (root >= 0)
    later = outside / torch.where(enters, inward + root.clamp(min=0).sqrt(), 1)
    immediate = (outside <= 0) & (inward > -slack * speed.sqrt())
    return torch.where(immediate, 0, torch.where(enters, later, math.inf))


def wall_contact(start, end, step, radius, slack=0.0):
    """The fraction (A, W) of steps (A, 1, 2) at which a disc at 0 touches walls with ends (A, W,
    2); inf if never.

    The disc touches a wall's flank where the distance to its infinite line falls to the radius,
    between the ends; the ends are points. A wall that overlaps the disc stops it if the disc
    approaches the wall's nearest point.
    """
    along = end - start
    length = along.norm(dim=-1)
    along = along / torch.where(length > 0, length, 1)[..., None]
    nearest = start + (-(start * along).sum(-1)).clamp(min=0).minimum(length)[..., None] * along
    overlaps = nearest.square().sum(-1) <= radius**2
    approaches = (nearest * step).sum(-1) > -slack * step.norm(dim=-1)
    height, sinking = cross(along, -start), cross(along, step.expand_as(along))
    meets = (length > 0) & (height.abs() > radius) & (height * sinking < 0)
    fraction = (height.abs() - radius) / torch.where(meets, sinking.abs(), 1)
    place = ((fraction[..., None] * step - start) * along).sum(-1)
    flank = torch.where(meets & (place >= 0) & (place <= length), fraction, math.inf)
    ends = torch.minimum(contact(-start, step, radius), contact(-end, step, radius))
    return torch.where(overlaps, torch.where(approaches, 0, math.inf), torch.minimum(flank, ends))


def physics(walls, positions, angles, velocity, angvelocity, *, fps=10.0, radius=RADIUS, slack=0.0):
    """Steps one environment. Returns progress (A,), and positions, angles, velocity, angvelocity.

    Progress is the fraction of the step that was travelled. `slack` metres make discs larger and
    more easily stopped: +slack and -slack bracket the true progress of slightly different inputs.
    """
    step = velocity / fps
    reach = INFLATION * radius + slack
    start, end = (corner - positions[:, None] for corner in walls.unbind(1))
    times = wall_contact(start, end, step[:, None], reach, slack)
    apart = positions[:, None] - positions[None]
    pairs = contact(apart, step[:, None] - step[None], 2 * INFLATION * radius + slack, slack)
    pairs = pairs.masked_fill(
        torch.eye(len(positions), dtype=torch.bool, device=positions.device), math.inf
    )
    first = torch.cat([times, pairs], -1).min(-1).values
    progress = torch.where(first <= 1, (SHORTFALL * first).clamp(0, 1), 1).to(positions)
    free = progress == 1
    return dict(
        progress=progress,
        positions=positions + progress[:, None] * step,
        angles=wrapped(angles + progress * angvelocity / fps),
        velocity=torch.where(free[:, None], velocity, 0),
        angvelocity=torch.where(free, angvelocity, 0),
    )
