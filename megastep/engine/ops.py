"""The engine: ``bake``, ``physics``, ``render``, ``observe``, ``unseen``, ``coverage``, ``spawn``,
``uniform``, ``pong``, ``shoot``, ``seek``. Each checks its arguments, allocates and launches, on
the CPU or the GPU, whichever its tensors are on; none synchronises. TypeError or ValueError, naming
the argument, if one does not fit.

N environments, A agents per environment, C cameras per agent (the axis is dropped if there is one),
R rays per camera, P = R / subsample pixels, D layouts, B lanes. Metres, degrees, seconds.
"""

import math

import torch

from megastep.engine import checks
from megastep.engine.agents import Agents, check_on_cpu
from megastep.engine.devices import threads
from megastep.engine.launch_params import (
    error_flag,
    lanes_of,
    scenery_params,
    seed_params,
    state_params,
)
from megastep.engine.outputs import Observation, Physics, Render
from megastep.engine.scenery import Scenery
from megastep.kernels.build.compile import BLOCK
from megastep.kernels.build.launch import SIZES, WARP, launch, params

BANDS = 3  # of distance from an agent: up to 1.5 m, up to 4 m, and beyond
SECTORS = 16  # of bearing from an agent
MANY_ENVS = 32_768  # that fill a GPU with a quarter of a warp each
MAX_SUBSAMPLE = 32


# ---- The operations ----


def bake(scenery: Scenery) -> None:
    """Fills ``scenery.layouts.baked``: min(1, 0.1 + sum of 2 I / max(d^2, 1)) over the lights that
    no wall of the layout occludes. Fits the bounding boxes to the walls first.
    """
    layouts = checks.instance("scenery", scenery, Scenery).layouts
    packed_scenery = scenery_params(scenery, 0.0)
    layouts.update_bounding_boxes()
    texel_wall = _owners(layouts.textures.widths, layouts.n_texels)
    wall_layout = _owners(layouts.lines.widths, layouts.n_walls)
    packed = params.BakeParams(
        scenery=packed_scenery,
        texel_wall=texel_wall.data_ptr(),
        wall_layout=wall_layout.data_ptr(),
        n_texels=layouts.n_texels,
    )
    launch("bake", packed, scenery.device, threads=layouts.n_texels)


def _owners(widths, total):
    """(total,) int32: the subarray that each element belongs to."""
    each = torch.arange(len(widths), dtype=torch.int32, device=widths.device)
    return torch.repeat_interleave(each, widths, output_size=total)


def physics(
    scenery: Scenery,
    agents: Agents,
    actions: torch.Tensor | None = None,
    moves: torch.Tensor | None = None,
    damping: float = 1.0,
) -> Physics:
    """Moves the agents by their velocities for 1 / fps seconds, each short of what it meets first:
    a wall, or another agent.

    If ``actions`` (N, A) int64 are given, each agent first loses the fraction ``damping`` of its
    velocities, and row ``action`` of ``moves`` (n_moves, 3) is added: m/s ahead and left, deg/s.
    """
    n, a = lanes = lanes_of(scenery, agents)
    checks.number("damping", damping, -math.inf, math.inf)
    on = scenery.device
    if actions is None and moves is None:
        n_moves = actions_at = moves_at = 0
    else:
        actions_at = checks.address("actions", actions, lanes, torch.int64, on)
        n_moves = checks.length("moves", moves)
        if not n_moves:
            raise ValueError("moves must have a row for each action, but it is empty")
        moves_at = checks.address("moves", moves, (n_moves, 3), torch.float32, on)
    progress = torch.empty(lanes, device=on)
    threads_per_env = 8 if n > MANY_ENVS else WARP
    packed = params.PhysicsParams(
        scenery=scenery_params(scenery, agents.radius),
        **state_params(scenery, agents, "positions", "angles", "velocity", "angvelocity"),
        progress=progress.data_ptr(),
        error_flag=error_flag(scenery, agents),
        actions=actions_at,
        moves=moves_at,
        n_moves=n_moves,
        retained=1 - damping,
        seconds=1 / agents.fps,
        threads_per_env=threads_per_env,
    )
    launch("physics", packed, on, threads=threads_per_env * n)
    check_on_cpu(agents)
    return Physics(progress)


def update_agent_geometry(scenery: Scenery, agents: Agents, lit: bool = True) -> None:
    """Moves the agents' lines to where the agents are and, if ``lit``, calculates the light on
    them.
    """
    n, a = lanes_of(scenery, agents)
    packed = params.UpdateAgentGeometryParams(
        scenery=scenery_params(scenery, agents.radius),
        **state_params(scenery, agents, "positions", "angles"),
        error_flag=error_flag(scenery, agents),
        lit=int(checks.flag("lit", lit)),
    )
    launch("update_agent_geometry", packed, scenery.device, threads=WARP * n * a)
    check_on_cpu(agents)


# What a view may give; 0: it is not wanted.
_OUTPUTS = dict.fromkeys(
    (
        *("indices", "locations", "dots", "distances", "screen"),
        *("rgb", "depth", "centre_line", "agent_ray", "velocity", "angvelocity", "imu"),
        *("seen", "clear_mask", "newly_seen", "n_words"),
    ),
    0,
)


def _render(scenery, agents, subsample=1, max_depth=10.0, **outputs):
    res, on = agents.res, scenery.device
    half_width = math.tan(math.radians(agents.fov / 2))
    fields = {
        name: value.data_ptr() if isinstance(value, torch.Tensor) else value
        for name, value in outputs.items()
        if value is not None
    }
    packed = params.RenderParams(
        scenery=scenery_params(scenery, agents.radius),
        **state_params(scenery, agents, "positions", "angles"),
        yaws=checks.address("agents.yaws", agents.yaws, (agents.n_cameras,), torch.float32, on),
        ray_lengths=checks.address(
            "agents.ray_lengths", agents.ray_lengths, (res,), torch.float32, on
        ),
        error_flag=error_flag(scenery, agents),
        n_cameras=agents.n_cameras,
        res=res,
        half_width=half_width,
        edge=half_width * (res - 1) / res,
        pitch=2 * half_width / res,
        centre=res / 2 - 0.5,
        scale=res / (2 * half_width),
        near=0.99 * agents.radius * math.cos(math.radians(agents.fov / 2)),
        subsample=subsample,
        n_pixels=res // subsample,
        inv_subsample=1 / subsample,
        inv_max_depth=1 / max_depth,
        **{**_OUTPUTS, **fields},
    )
    shared = SIZES["NearestLine"] * WARP * -(-res // WARP)
    threads = WARP * scenery.n_envs * scenery.n_agents
    launch("render", packed, on, threads, shared)
    check_on_cpu(agents)


def _per_camera(lanes, agents):
    return lanes if agents.n_cameras == 1 else (*lanes, agents.n_cameras)


def render(scenery: Scenery, agents: Agents) -> Render:
    """What every camera sees, after moving the agents' lines to where the agents are."""
    update_agent_geometry(scenery, agents)
    on, shape = scenery.device, (*_per_camera(lanes_of(scenery, agents), agents), agents.res)
    out = Render(
        indices=torch.empty(shape, dtype=torch.int32, device=on),
        locations=torch.empty(shape, device=on),
        dots=torch.empty(shape, device=on),
        distances=torch.empty(shape, device=on),
        screen=torch.empty((*shape, 3), device=on),
    )
    _render(scenery, agents, **out._asdict())
    return out


def observe(
    scenery: Scenery,
    agents: Agents,
    subsample: int = 1,
    rgb: bool = True,
    depth: bool = True,
    imu: bool = False,
    centre_line: bool = False,
    agent_ray: bool = False,
    seen: torch.Tensor | None = None,
    clear_mask: torch.Tensor | None = None,
    max_depth: float = 10.0,
) -> Observation:
    """What training needs of a view, in one pass: a fused form of :func:`render` and the sensors of
    :mod:`~megastep.modules`.

    Args: ``subsample`` rays per pixel, a divisor of res; ``seen`` (N, A, n_words) int32, a bit for
    each static texel of the environment's layout, updated in place; ``clear_mask`` (N, A) bool,
    where ``seen`` is cleared first; ``max_depth`` metres. With one agent per environment,
    ``scenery.lines`` is left as it was.
    """
    n, a = lanes = lanes_of(scenery, agents)
    on = scenery.device
    if agents.res % checks.integer("subsample", subsample, 1, MAX_SUBSAMPLE):
        raise ValueError(
            f"subsample must divide the {agents.res} rays of a camera, but {subsample} was given"
        )
    checks.number("max_depth", max_depth, 0, math.inf, "metres")
    wanted = dict(rgb=rgb, depth=depth, imu=imu, centre_line=centre_line, agent_ray=agent_ray)
    for name, value in wanted.items():
        checks.flag(name, value)
    seen_fields = {}
    if seen is not None or clear_mask is not None:
        seen_fields = _seen(scenery, seen, clear_mask)
    if a > 1:
        update_agent_geometry(scenery, agents, lit=rgb)
    shape, pixels = _per_camera(lanes, agents), agents.res // subsample
    half, int32 = torch.float16, torch.int32
    out = Observation(
        rgb=torch.empty((*shape, 3, pixels), dtype=half, device=on) if rgb else None,
        depth=torch.empty((*shape, pixels), dtype=half, device=on) if depth else None,
        centre_line=torch.empty(shape, dtype=int32, device=on) if centre_line else None,
        agent_ray=torch.empty(shape, dtype=int32, device=on) if agent_ray else None,
        imu=torch.empty((n, a, 3), dtype=half, device=on) if imu else None,
        newly_seen=torch.empty(lanes, dtype=int32, device=on) if seen_fields else None,
    )
    moving = state_params(scenery, agents, "velocity", "angvelocity") if imu else {}
    _render(scenery, agents, subsample, max_depth, **moving, **seen_fields, **out._asdict())
    return out


def _seen(scenery, seen, clear_mask):
    """The addresses of the texels seen and of the mask that clears them."""
    lanes, on = (scenery.n_envs, scenery.n_agents), scenery.device
    if seen is None:
        raise ValueError("clear_mask clears seen, but seen was not given")
    mask = 0
    if clear_mask is not None:
        mask = checks.address("clear_mask", clear_mask, lanes, torch.bool, on)
    at, n_words = _texel_bits(scenery, "seen", seen, lanes)
    return dict(seen=at, clear_mask=mask, n_words=n_words)


def _texel_bits(scenery, name, bits, owners):
    """The address of (*owners, n_words) int32, a bit for each texel of a layout, and n_words."""
    needed = -(-scenery.layouts.max_texels // 32)
    n_words = checks.length(name, bits, axis=-1)
    if n_words < needed:
        raise ValueError(
            f"{name} must have a bit for each of a layout's texels, so at least {needed} words, "
            f"but it has {n_words}"
        )
    at = checks.address(name, bits, (*owners, n_words), torch.int32, scenery.device)
    return at, n_words


def unseen(
    scenery: Scenery, agents: Agents, seen: torch.Tensor, visible: torch.Tensor
) -> torch.Tensor:
    """Where the texels are that an agent has not seen yet, of those that are visible at all: (N, A,
    3, 16) int32, how many lie within 1.5 m, within 4 m and beyond, in each of 16 sectors of 22.5
    degrees, the first straight ahead, the next further left. Texels of one wall that share a word
    count together, where their middle lies.

    Args: ``seen`` (N, A, n_words) int32, as of :func:`observe`; ``visible`` (D, n_words) int32, as
    of :func:`~megastep.modules.visible_texels`.
    """
    n, a = lanes_of(scenery, agents)
    counts = torch.empty((n, a, BANDS, SECTORS), dtype=torch.int32, device=scenery.device)
    packed = params.UnseenParams(
        scenery=scenery_params(scenery, agents.radius),
        **state_params(scenery, agents, "positions", "angles"),
        **_seen_and_visible(scenery, seen, visible),
        error_flag=error_flag(scenery, agents),
        counts=counts.data_ptr(),
    )
    launch("unseen", packed, scenery.device, threads=BLOCK * n * a)
    check_on_cpu(agents)
    return counts


def coverage(
    scenery: Scenery,
    agents: Agents,
    seen: torch.Tensor,
    visible: torch.Tensor,
    mask: torch.Tensor,
) -> torch.Tensor:
    """The share that an agent has seen of the texels of its environment's layout that are visible
    at all: (N, A) float32, 0 where not in ``mask`` (N, A) bool.

    Args: ``seen`` and ``visible`` as of :func:`unseen`.
    """
    lanes, on = lanes_of(scenery, agents), scenery.device
    shares = torch.empty(lanes, device=on)
    packed = params.CoverageParams(
        scenery=scenery_params(scenery, agents.radius),
        **_seen_and_visible(scenery, seen, visible),
        mask=checks.address("mask", mask, lanes, torch.bool, on),
        error_flag=error_flag(scenery, agents),
        coverage=shares.data_ptr(),
    )
    launch("coverage", packed, on, threads=shares.numel())
    check_on_cpu(agents)
    return shares


def _seen_and_visible(scenery, seen, visible):
    """The addresses of the texels seen and visible, and how many words they have."""
    on = scenery.device
    seen_at, n_words = _texel_bits(scenery, "seen", seen, (scenery.n_envs, scenery.n_agents))
    shape = len(scenery.layouts), n_words
    visible_at = checks.address("visible", visible, shape, torch.int32, on)
    return dict(seen=seen_at, visible=visible_at, n_words=n_words)


def spawn(
    scenery: Scenery,
    agents: Agents,
    mask: torch.Tensor,
    points: torch.Tensor,
    counts: torch.Tensor,
    seed: int,
    resample: bool = False,
    hidden: bool = False,
    chosen: torch.Tensor | None = None,
) -> None:
    """Puts agents at random points of their environment's layout, at rest, looking anywhere. Each
    draws once from its random stream.

    ``hidden``: out of sight of whoever stands in the environment, but for gaps as narrow as an
    agent's radius, if it has such a point; else at the one furthest from whoever is nearest to it.
    Agents take turns: those who have respawned stand.

    Args: ``mask`` (N, A) bool, who; ``points`` (D, n, 2), of which the agents of one environment
    have n / A each; ``counts`` (N, A) int32, numbers drawn so far, advanced here; ``resample``: an
    environment whose agents all respawn moves to a random layout first; ``chosen`` (N, A) int32,
    where the numbers of the points that agents went to are written.
    """
    lanes, on, n_layouts = lanes_of(scenery, agents), scenery.device, len(scenery.layouts)
    n_points = checks.length("points", points, axis=1)
    if n_points < scenery.n_agents:
        raise ValueError(
            f"points must be at least as many per layout as there are agents, so "
            f"{scenery.n_agents}, but {n_points} were given"
        )
    packed = params.SpawnParams(
        scenery=scenery_params(scenery, agents.radius),
        **state_params(scenery, agents, "positions", "angles", "velocity", "angvelocity"),
        mask=checks.address("mask", mask, lanes, torch.bool, on),
        points=checks.address("points", points, (n_layouts, n_points, 2), torch.float32, on),
        counts=checks.address("counts", counts, lanes, torch.int32, on),
        chosen=0 if chosen is None else checks.address("chosen", chosen, lanes, torch.int32, on),
        error_flag=error_flag(scenery, agents),
        **seed_params(seed),
        n_points=n_points,
        resample=int(checks.flag("resample", resample)),
    )
    if checks.flag("hidden", hidden):
        launch("spawn_hidden", packed, on, threads=WARP * scenery.n_envs)
    else:
        launch("spawn", packed, on, threads=scenery.n_envs)
    check_on_cpu(agents)


def uniform(counts: torch.Tensor, mask: torch.Tensor, seed: int, out: torch.Tensor) -> torch.Tensor:
    """Uniform numbers in [0, 1), four per lane: Philox 4x32-10 with key ``seed`` and counter (lane,
    count). Returns ``out``.

    Args: ``counts`` (B,) int32, numbers each lane has drawn, advanced by one where ``mask`` (B,)
    bool; ``out`` (B, 4), written where ``mask``.
    """
    n, on = checks.length("counts", counts), counts.device
    packed = params.UniformParams(
        counts=checks.address("counts", counts, (n,), torch.int32, on),
        mask=checks.address("mask", mask, (n,), torch.bool, on),
        out=checks.address("out", out, (n, 4), torch.float32, on),
        **seed_params(seed),
        n_lanes=n,
        n_threads=threads(),
    )
    launch("uniform", packed, on, threads=n)
    counts.add_(mask)
    return out
