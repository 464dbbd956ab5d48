"""Operations of one launch: light, movement, spawning, objects, random numbers, by the
counter-based generator Philox 4x32-10. N environments, A agents and O objects each, D layouts, B
lanes.
"""

import math
from typing import NamedTuple

import torch

from megastep import cache
from megastep.devices import n_resident_threads, threads
from megastep.engine import checks
from megastep.engine.agents import Agents
from megastep.engine.launch_params import (
    MOTION,
    POSE,
    lanes_of,
    launch_in,
    object_params,
    scenery_params,
    seed_params,
)
from megastep.engine.scenery import Scenery
from megastep.kernels.build.launch import BLOCK, ENGINE, WARP, Blocks, launch

#: Threads that move an environment's agents, on a GPU: the most with which all environments move
#: at once, or else the least.
GROUPS = (32, 16, 8)
#: Blocks that a multiprocessor holds, by the bounds of `physics_unspilled`.
UNSPILLED_BLOCKS = 18
APART = 0.05  # metres
MAX_SPAWN_WARPS = 1 << 15  # that look whether agents respawn where there are objects
#: Of baked light in the cache: how names of files begin, most files and bytes, fewest layouts.
PREFIX, MAX_FILES, MAX_BYTES, MIN_CACHED = "baked-light-", 256, 512e6, 32
MAX_SLOTS = ENGINE.constants["MAX_SLOTS"]  # agents and movable objects of an environment
BODIES_BYTES, SLOT_BYTES = (ENGINE.constants[name] for name in ("BODIES_BYTES", "SLOT_BYTES"))


def bake(scenery: Scenery) -> None:
    """Writes the light on every wall texel, ``scenery.layouts.baked``, and refits the walls'
    bounding boxes. Call it after moving walls or lights. The light is min(1, 0.1 + sum of 2 I /
    max(d^2, 1)) over the lights of the layout that no wall occludes, of intensity I, d metres away.
    """
    layouts = checks.instance("scenery", scenery, Scenery).layouts
    layouts.update_bounding_boxes()
    launch(
        *(ENGINE, "bake", scenery.device, layouts.n_texels),
        scenery=scenery_params(scenery, 0.0),
        texel_wall=_owners(layouts.textures.widths, layouts.n_texels),
        wall_layout=_owners(layouts.lines.widths, layouts.n_walls),
        n_texels=layouts.n_texels,
    )


def bake_cached(scenery: Scenery) -> None:
    """Does what :func:`bake` does, on a CPU by the cache on disk: 512 homes take half a second."""
    layouts = scenery.layouts
    if scenery.device.type != "cpu" or len(layouts) < MIN_CACHED:
        return bake(scenery)

    def build() -> dict:
        bake(scenery)
        return dict(light=layouts.baked.vals.numpy())

    of_lights = layouts.lights.vals, layouts.light_starts
    tensors = layouts.lines.vals, layouts.wall_starts, layouts.texel_starts, *of_lights
    parts = ENGINE.sources(".h", ".cpp"), *(tensor.numpy() for tensor in tensors)
    light = cache.arrays(PREFIX, parts, build, MAX_FILES, MAX_BYTES)["light"]
    layouts.baked.vals.copy_(torch.from_numpy(light))
    return None


def _owners(widths, total) -> torch.Tensor:
    """Returns (total,) int32, the subarray that each element belongs to."""
    subarrays = torch.arange(len(widths), dtype=torch.int32, device=widths.device)
    return torch.repeat_interleave(subarrays, widths, output_size=total)


class Physics(NamedTuple):
    """The outcome of a step of physics."""

    progress: torch.Tensor  # (N, A): free fraction of the step; below 1, the agent hit something


def physics(
    scenery: Scenery,
    agents: Agents,
    actions: torch.Tensor | None = None,
    moves: torch.Tensor | None = None,
    damping: float = 1.0,
) -> Physics:
    """Moves the agents by their velocities for 1 / fps seconds, in place. An agent stops just
    before the first wall, agent or solid object that it touches, and its velocities become 0.

    With movable objects, agents push these and slide along what they touch. Their velocity follows
    what actions ask for as fast as ``objects.force`` allows; those of objects change in place too.

    Args:
        actions: (N, A) int64, or (N, A, n_moves) float32. If given, velocities are first multiplied
            by ``1 - damping``. An integer then adds one row of ``moves``. Floats, clipped to
            [-1, 1], add all rows, weighted. If None, ``moves`` must be None too.
        moves: (n_moves, 3) m/s ahead, m/s left, deg/s, added by actions.
        damping: fraction of the velocities lost per step.
    """
    n, a = lanes = lanes_of(scenery, agents)
    checks.number("damping", damping, -math.inf, math.inf)
    device = scenery.device
    n_moves = actions_at = controls_at = moves_at = 0
    if actions is not None or moves is not None:
        n_moves = checks.length("moves", moves)
        if not n_moves:
            raise ValueError("moves must have one row per action, but it has none")
        moves_at = checks.address("moves", moves, (n_moves, 3), torch.float32, device)
        if isinstance(actions, torch.Tensor) and actions.is_floating_point():
            shape = (*lanes, n_moves)
            controls_at = checks.address("actions", actions, shape, torch.float32, device)
        else:
            actions_at = checks.address("actions", actions, lanes, torch.int64, device)
    progress = torch.empty(lanes, device=device)
    # with more registers per thread until environments are many, by what is faster on an H200
    is_many = GROUPS[-1] * n > n_resident_threads(device)
    kernel = "physics" if scenery.objects is None else "physics_objects"
    kernel = kernel if is_many else f"{kernel}_unspilled"
    room = n_resident_threads(device, UNSPILLED_BLOCKS)
    threads_per_env = next((size for size in GROUPS if size * n <= room), GROUPS[-1])
    shape, of_bodies = threads_per_env * n, {}
    if scenery.objects is not None and scenery.objects.n_bodies:
        n_free = MAX_SLOTS - a - scenery.objects.n_bodies
        if n_free < 0:
            raise ValueError(
                f"an environment has at most {MAX_SLOTS} agents and movable objects together, but "
                f"there are {a} and {scenery.objects.n_bodies}"
            )
        n_envs = BLOCK // WARP  # per block
        n_bytes = n_envs * (BODIES_BYTES - n_free * SLOT_BYTES)
        kernel, shape = "physics_bodies", Blocks(-(-n // n_envs), shared=n_bytes)
        names = "force", "grip", "ramp_steps", "grab_elevated"
        of_bodies = {name: getattr(scenery.objects, name) for name in names}
    launch_in(
        *(scenery, agents, kernel, shape, *MOTION),
        **of_bodies,
        progress=progress,
        actions=actions_at,
        controls=controls_at,
        moves=moves_at,
        n_moves=n_moves,
        retained=1 - damping,
        seconds=1 / agents.fps,
        threads_per_env=threads_per_env,
        objects=object_params(scenery),
    )
    return Physics(progress)


def spawn(
    scenery: Scenery,
    agents: Agents,
    mask: torch.Tensor,
    points: torch.Tensor,
    counts: torch.Tensor,
    seed: int,
    resample: bool = False,
    hidden: bool = False,
    point_index: torch.Tensor | None = None,
    cumulative: torch.Tensor | None = None,
) -> None:
    """Puts agents at random points of their environment's layout, at rest, with random headings.
    They drop what they carry, and avoid points on solid objects, unless these were of another
    layout.

    Args:
        mask: (N, A) bool, agents to respawn.
        points: (D, n, 2) metres. Each agent has n / A points of a layout, agent 0 the first ones.
        counts: (N, A) int32, numbers drawn so far. Each respawned agent's is advanced by one.
        seed: the generator's key.
        resample: if all agents of an environment respawn, move it to a random layout first.
        hidden: choose a point that no other agent of the environment sees, except through gaps
            narrower than an agent's radius. If there is none, choose the point that is furthest
            from its nearest agent. Agents respawn one after the other and avoid those before them.
        point_index: (N, A) int32, receives the index of each respawned agent's point.
        cumulative: (D,) int32, cumulative weights of the layouts, by which `resample` draws them:
            whole numbers from 0 whose sum, the last entry, is from 1 to 2**31 - 1. Default: every
            layout is as likely.
    """
    lanes, device, n_layouts = lanes_of(scenery, agents), scenery.device, len(scenery.layouts)
    n_points = checks.length("points", points, axis=1)
    if n_points < scenery.n_agents:
        raise ValueError(
            f"points must have at least one per agent in each layout, so {scenery.n_agents}, but "
            f"{n_points} were given"
        )
    int32 = torch.int32, device
    kernel = "spawn_hidden" if checks.flag("hidden", hidden) else "spawn"
    kernel += "" if scenery.objects is None else "_objects"
    per_warp = -(-scenery.n_envs // MAX_SPAWN_WARPS) if kernel == "spawn_objects" else 1
    n_threads = scenery.n_envs if kernel == "spawn" else -(-scenery.n_envs // per_warp) * WARP
    launch_in(
        *(scenery, agents, kernel, n_threads, *MOTION),
        mask=checks.address("mask", mask, lanes, torch.bool, device),
        points=checks.address("points", points, (n_layouts, n_points, 2), torch.float32, device),
        counts=checks.address("counts", counts, lanes, *int32),
        point_index=checks.address("point_index", point_index, lanes, *int32, True),
        cumulative=checks.address("cumulative", cumulative, (n_layouts,), *int32, True),
        **seed_params(seed),
        n_points=n_points,
        resample=int(checks.flag("resample", resample)),
        per_warp=per_warp,
        objects=object_params(scenery),
    )


def uniform(counts: torch.Tensor, mask: torch.Tensor, seed: int, out: torch.Tensor) -> torch.Tensor:
    """Draws four uniform numbers in [0, 1) for each lane of ``mask``, (B,) bool, into ``out``,
    (B, 4) float32, which it returns. ``counts``, (B,) int32, are the numbers drawn so far, advanced
    by one where ``mask``: with the lane, the generator's counter. Its key is the seed.
    """
    n, device = checks.length("counts", counts), counts.device
    launch(
        *(ENGINE, "uniform", device, n),
        counts=checks.address("counts", counts, (n,), torch.int32, device),
        mask=checks.address("mask", mask, (n,), torch.bool, device),
        out=checks.address("out", out, (n, 4), torch.float32, device),
        **seed_params(seed),
        n_lanes=n,
        n_threads=threads(),
    )
    counts.add_(mask)
    return out


def update_objects(scenery: Scenery, agents: Agents) -> None:
    """Moves carried objects to their carriers, and writes all objects' lines and texels. Does
    nothing if the scenery has no objects. :func:`render` and :func:`observe` do this first.
    """
    n, _ = lanes_of(scenery, agents)
    if scenery.objects is None:
        return
    launch_in(
        *(scenery, agents, "update_objects", n * scenery.objects.n_objects, *POSE),
        objects=object_params(scenery),
    )


def place_objects(
    scenery: Scenery,
    agents: Agents,
    mask: torch.Tensor,
    points: torch.Tensor,
    counts: torch.Tensor,
    seed: int,
    apart: float = APART,
) -> None:
    """Puts objects at random points of their environment's layout, visible, carried by nobody, at
    random angles: each at the first point, counted from a random one, that is at least ``apart``
    from agents and visible objects. Crates and doors count as discs of their size. Objects that are
    placed by the same call do not keep clear of each other's old positions.

    Args:
        mask: (N, O) bool, objects to place.
        points: (D, n, 2) metres.
        counts: (N, O) int32, numbers drawn so far. Each placed object's is advanced by one.
        seed: the generator's key.
        apart: metres.
    """
    lanes_of(scenery, agents)
    if scenery.objects is None:
        raise ValueError("scenery has no objects: set scenery.objects = engine.Objects(...) first")
    device, shape = scenery.device, (scenery.n_envs, scenery.objects.n_objects)
    n_points = checks.length("points", points, axis=1)
    checks.integer("the number of points per layout", n_points, 1)
    points_shape = len(scenery.layouts), n_points, 2
    launch_in(
        *(scenery, agents, "place_objects", scenery.n_envs, *POSE),
        objects=object_params(scenery),
        mask=checks.address("mask", mask, shape, torch.bool, device),
        points=checks.address("points", points, points_shape, torch.float32, device),
        counts=checks.address("counts", counts, shape, torch.int32, device),
        **seed_params(seed),
        n_points=n_points,
        apart=checks.number("apart", apart, -1, checks.LIMIT, "metres"),
    )
