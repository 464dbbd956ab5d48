"""Rendering: what cameras see, at full resolution or as observations, and what lidars measure. N
environments, A agents per environment, C cameras per agent (the axis is dropped if there is one), R
rays per camera, P = R / subsample pixels.
"""

import math
from typing import NamedTuple

import torch

from megastep.devices import n_resident_threads
from megastep.engine import checks
from megastep.engine.agents import MAX_RES, Agents
from megastep.engine.checks import LIMIT
from megastep.engine.launch_params import POSE, lanes_of, launch_in, object_params, state_params
from megastep.engine.operations import update_objects
from megastep.engine.scenery import Scenery
from megastep.kernels.build.launch import BLOCK, ENGINE, WARP, Blocks

MAX_SUBSAMPLE = ENGINE.constants["MAX_SUBSAMPLE"]
NEAREST_LINE_BYTES = ENGINE.constants["NEAREST_LINE_BYTES"]
#: Of an object's line, or its texel, in shared memory.
LINE_BYTES = 16
#: Agents are many if they need more threads than this many times those that a GPU runs at once, by
#: what is faster on an H200.
UNSPILLED_WAVES = 4


class Render(NamedTuple):
    """The cameras' views, ray by ray. A ray that hits nothing has -1, NaN, NaN, inf, black."""

    indices: torch.Tensor  # (N, A, C, R) int32: the line hit, an index into its environment
    locations: torch.Tensor  # (N, A, C, R): position along the line, 0 to 1
    dots: torch.Tensor  # (N, A, C, R): cosine between ray and line
    distances: torch.Tensor  # (N, A, C, R): metres
    screen: torch.Tensor  # (N, A, C, R, 3): linear light; call gamma_encode to display it


class Observation(NamedTuple):
    """Observations for a policy; None where not requested."""

    rgb: torch.Tensor | None  # (N, A, C, 3, P) fp16, linear light
    depth: torch.Tensor | None  # (N, A, C, P) fp16: 1 at the agent's radius, 0 at max_depth beyond
    centre_line: torch.Tensor | None  # (N, A, C) int32: the line at the centre, as Render.indices
    agent_ray: torch.Tensor | None  # (N, A, C) int32: ray closest to the centre that hits an agent
    imu: torch.Tensor | None  # (N, A, 3) fp16: angvelocity / 360, own velocity ahead and left / 10
    newly_seen: torch.Tensor | None  # (N, A) int32: texels newly marked in `seen`


#: RenderParams' optional outputs, and the inputs that only these need. 0 is null: not wanted.
_OPTIONAL = dict.fromkeys(
    (
        *(*Render._fields, *Observation._fields),
        *("velocity", "angvelocity", "seen", "clear_mask", "n_words", "only"),
    ),
    0,
)


def update_agent_geometry(scenery: Scenery, agents: Agents, lit: bool = True) -> None:
    """Moves the agents' lines to their current poses, and computes the light on them if ``lit``."""
    n, a = lanes_of(scenery, agents)
    lit = checks.flag("lit", lit)
    launch_in(scenery, agents, "update_agent_geometry", WARP * n * a, *POSE, lit=int(lit))


def render(scenery: Scenery, agents: Agents) -> Render:
    """Renders every camera at full resolution, for people and tests. Also updates the agents' lines
    in ``scenery``. Training uses :func:`observe`, which is faster.
    """
    update_agent_geometry(scenery, agents)
    update_objects(scenery, agents)
    device, shape = scenery.device, (*_per_camera(scenery, agents), agents.res)
    out = Render(
        indices=torch.empty(shape, dtype=torch.int32, device=device),
        locations=torch.empty(shape, device=device),
        dots=torch.empty(shape, device=device),
        distances=torch.empty(shape, device=device),
        screen=torch.empty((*shape, 3), device=device),
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
    only: torch.Tensor | None = None,
    out: Observation | None = None,
) -> Observation:
    """Renders what training needs, in one pass and without full-resolution tensors: the same as
    :func:`render` followed by the sensors of :mod:`~megastep.modules`. With one agent per
    environment, ``scenery.lines`` is not updated, nor are unlit objects' lines.

    Args:
        subsample: rays per pixel, a divisor of ``agents.res``; at most 32.
        rgb, depth, imu, centre_line, agent_ray: which fields of :class:`Observation` to compute.
        seen: (N, A, n_words) int32, one bit per static texel of the environment's layout. Texels in
            view are marked in place and counted in ``newly_seen``.
        clear_mask: (N, A) bool, agents whose ``seen`` is cleared first.
        max_depth: metres beyond the agent's radius at which depth reads 0.
        only: (N, A) bool, agents to render. The others keep their rows of ``out`` and ``seen``.
        out: what the same call returned before; written in place and returned.
    """
    lanes, device = lanes_of(scenery, agents), scenery.device
    if agents.res % checks.integer("subsample", subsample, 1, MAX_SUBSAMPLE):
        raise ValueError(
            f"subsample must divide the {agents.res} rays of a camera, but {subsample} was given"
        )
    checks.number("max_depth", max_depth, 0, math.inf, "metres")
    wanted = dict(rgb=rgb, depth=depth, imu=imu, centre_line=centre_line, agent_ray=agent_ray)
    for name, value in wanted.items():
        checks.flag(name, value)
    seen_fields = {}
    if seen is not None:
        n_words, at_least = checks.length("seen", seen, -1), -(-scenery.layouts.max_texels // 32)
        checks.integer("the last axis of seen, words of 32 texels,", n_words, at_least)
        address = checks.address("seen", seen, (*lanes, n_words), torch.int32, device)
        mask = checks.address("clear_mask", clear_mask, lanes, torch.bool, device, True)
        seen_fields = dict(seen=address, n_words=n_words, clear_mask=mask)
    elif clear_mask is not None:
        raise ValueError("clear_mask clears seen, but seen was not given")
    seen_fields["only"] = checks.address("only", only, lanes, torch.bool, device, True)
    if out is not None:
        checks.instance("out", out, Observation)
    elif only is not None:
        raise ValueError("with only, some agents are not rendered: give out, which has their rows")
    if scenery.n_agents > 1:
        update_agent_geometry(scenery, agents, lit=rgb)
    shape, pixels = _per_camera(scenery, agents), agents.res // subsample
    half, int32 = torch.float16, torch.int32
    out = out or Observation(
        rgb=torch.empty((*shape, 3, pixels), dtype=half, device=device) if rgb else None,
        depth=torch.empty((*shape, pixels), dtype=half, device=device) if depth else None,
        centre_line=torch.empty(shape, dtype=int32, device=device) if centre_line else None,
        agent_ray=torch.empty(shape, dtype=int32, device=device) if agent_ray else None,
        imu=torch.empty((*lanes, 3), dtype=half, device=device) if imu else None,
        newly_seen=torch.empty(lanes, dtype=int32, device=device) if seen is not None else None,
    )
    if scenery.objects is not None and scenery.objects.lit:
        update_objects(scenery, agents)
    moving = state_params(scenery, agents, "velocity", "angvelocity") if imu else {}
    optional = {**moving, **seen_fields, **out._asdict()}
    _render(scenery, agents, subsample, max_depth, **optional)
    return out


def scan(
    scenery: Scenery, agents: Agents, n_rays: int, range_min: float = 0.0, range_max: float = LIMIT
) -> torch.Tensor:
    """Returns the metres to the nearest wall along rays around each agent, (N, A, n_rays), with the
    meaning of ROS's LaserScan (REP 117): ray 0 looks ahead, along +x, the others follow
    counter-clockwise, all 360 / n_rays degrees apart; inf beyond ``range_max``, -inf below
    ``range_min``. Sees walls only. ValueError if there are objects or several agents.
    """
    lanes, device = lanes_of(scenery, agents), scenery.device
    n_rays = checks.integer("n_rays", n_rays, 1, MAX_RES)
    checks.number("range_max", range_max, 0, math.inf, "metres")
    checks.number("range_min", range_min, -1, range_max, "metres")
    if scenery.n_agents != 1 or scenery.objects is not None:
        raise ValueError(
            "scan sees walls only, but the scenery has objects or more than one agent per "
            "environment: use cameras there"
        )
    ranges = torch.empty((*lanes, n_rays), device=device)
    launch_in(
        *(scenery, agents, "scan", ranges.numel(), *POSE),
        ranges=ranges,
        n_rays=n_rays,
        pitch=360 / n_rays,
        range_min=range_min,
        range_max=range_max,
    )
    return ranges


def _per_camera(scenery, agents) -> tuple[int, ...]:
    lanes = lanes_of(scenery, agents)
    return lanes if agents.n_cameras == 1 else (*lanes, agents.n_cameras)


def _kernel(scenery, res, subsample, only=None) -> str:
    n_threads = WARP * scenery.n_envs * scenery.n_agents
    room = n_resident_threads(scenery.device)
    # two warps per agent, if agents are few, share whole tiles of the screen: of whole pixels
    if (1 if only else 3) * n_threads <= room and res > WARP and WARP % subsample == 0:
        return "render_split"
    # with more registers for each warp, until agents are many
    return "render_unspilled" if n_threads <= UNSPILLED_WAVES * room else "render"


def _render(scenery, agents, subsample=1, max_depth=10.0, **outputs) -> None:
    res = agents.res
    half_width = math.tan(math.radians(agents.fov / 2))
    shared = NEAREST_LINE_BYTES * WARP * -(-res // WARP)  # of an agent
    n = scenery.n_envs * scenery.n_agents
    kernel = _kernel(scenery, res, subsample, outputs.get("only"))
    kernel = "render" if "indices" in outputs else kernel
    n_warps = BLOCK // WARP
    n_per_block = 1 if kernel == "render_split" else n_warps
    shared *= n_per_block
    if scenery.objects is not None:  # which each warp draws for itself
        n_drawn = len(scenery.objects.line_object) + scenery.objects.n_objects
        shared += LINE_BYTES * n_drawn * n_warps
        kernel = kernel.replace("render", "render_objects")
    launch_in(
        *(scenery, agents, kernel, Blocks(-(-n // n_per_block), shared=shared), *POSE),
        yaws=agents.yaws,
        ray_lengths=agents.ray_lengths,
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
        objects=object_params(scenery),
        **{**_OPTIONAL, **outputs},
    )
