"""The engine: ``bake``, ``physics``, ``render``, ``observe``. Each checks, allocates and launches,
on the CPU or the GPU, whichever its tensors are on.

N worlds, A agents a world, C cameras an agent (the axis is dropped if there is one), R rays a
camera, P = R / subsample pixels. Metres, degrees, seconds.
"""

import math
from typing import NamedTuple

import torch

from .kernels.compile import EngineError
from .kernels.launch import SIZES, WARP, launch, params
from .scenery import Layouts, Scenery

__all__ = [
    "Agents",
    "Layouts",
    "EngineError",
    "Observation",
    "Physics",
    "Render",
    "Scenery",
    "bake",
    "check",
    "device",
    "uniform",
    "fit",
    "observe",
    "physics",
    "render",
    "spawn",
]

AGENT_WIDTH = 0.15
AGENT_RADIUS = AGENT_WIDTH / 2**0.5  # the disc about a square of that width
MAX_RES = 1024
MANY = 32_768  # worlds that fill a GPU with a quarter of a warp each


class Agents:
    """Where the agents are, how they move, and what their cameras are like.

    ``positions`` (N, A, 2), ``angles`` (N, A), ``velocity`` (N, A, 2) a second, ``angvelocity`` (N,
    A) a second; an angle of 0 looks along +x. ``cameras`` are yaw offsets in degrees. ValueError
    unless 1 <= res <= 1024, 0 < fov < 180, fps > 0, radius > 0.
    """

    def __init__(
        self,
        n_envs,
        n_agents,
        res=64,
        fov=130.0,
        fps=10.0,
        cameras=None,
        radius=AGENT_RADIUS,
        device="cpu",
    ):
        if not (isinstance(res, int) and 1 <= res <= MAX_RES):
            raise ValueError(
                f"res must be a whole number of rays from 1 to {MAX_RES}, but {res} was given"
            )
        if not 0 < fov < 180:
            raise ValueError(
                f"fov must be more than 0 and less than 180 degrees, but {fov} was given; for a "
                f"wider view use "
                f"several cameras"
            )
        if not 0 < fps < math.inf:
            raise ValueError(
                f"fps must be a positive number of steps a second, but {fps} was given"
            )
        if not 0 < radius < math.inf:
            raise ValueError(f"radius must be a positive number of metres, but {radius} was given")
        self.res, self.fov, self.fps, self.radius = res, float(fov), float(fps), float(radius)
        self.yaws = torch.tensor(
            [0.0] if cameras is None else list(cameras), dtype=torch.float32, device=device
        )
        if not len(self.yaws):
            raise ValueError("an agent needs at least one camera, but an empty list was given")
        sideways = math.tan(math.radians(fov / 2)) * (
            1 - (2 * torch.arange(res, dtype=torch.float64) + 1) / res
        )
        self.ray_lengths = (1 + sideways**2).sqrt().float().to(device)  # (R,), per unit of depth
        self.positions = torch.zeros((n_envs, n_agents, 2), device=device)
        self.angles = torch.zeros((n_envs, n_agents), device=device)
        self.velocity = torch.zeros((n_envs, n_agents, 2), device=device)
        self.angvelocity = torch.zeros((n_envs, n_agents), device=device)
        self.error_flag = torch.zeros(1, dtype=torch.int32, device=device)


class Render(NamedTuple):
    """What the cameras see, ray by ray. A miss is -1, NaN, NaN, inf, black."""

    indices: (
        torch.Tensor
    )  # (N, A, C, R) int32: the line hit, counted within its world, the agents' first
    locations: torch.Tensor  # (N, A, C, R): where along the line, 0 to 1
    dots: torch.Tensor  # (N, A, C, R): cosine between ray and line
    distances: torch.Tensor  # (N, A, C, R): metres
    screen: torch.Tensor  # (N, A, C, R, 3): linear light; gamma_encode it before showing it


class Physics(NamedTuple):
    """``progress`` (N, A): the fraction of the step that was free; below 1 the agent met something
    and its velocities are now 0.
    """

    progress: torch.Tensor


class Observation(NamedTuple):
    """What a policy needs of a view; None where not asked for."""

    rgb: torch.Tensor  # (N, A, C, 3, P) fp16, linear light
    depth: (
        torch.Tensor
    )  # (N, A, C, P) fp16: 1 at the agent's radius, falling to 0 at max_depth beyond it
    centre_line: torch.Tensor  # (N, A, C) int32: the line at the screen's centre, as Render.indices
    imu: torch.Tensor  # (N, A, 3) fp16: angular velocity / 360, own velocity ahead and left / 10
    newly_seen: (
        torch.Tensor
    )  # (N, A) int32: static texels now marked in `seen` that were not before


def device(name="auto"):
    """The device called ``name``: auto (a GPU if there is one), cpu, cuda, cuda:1. EngineError if
    it is not there.
    """
    if name == "auto":
        return (
            torch.device("cuda", torch.cuda.current_device())
            if torch.cuda.is_available()
            else torch.device("cpu")
        )
    try:
        chosen = torch.device(name)
    except RuntimeError:
        chosen = None
    if chosen is None or chosen.type not in ("cpu", "cuda"):
        raise EngineError(f"device={name} is unknown: use auto, cpu, cuda, or cuda: and a number.")
    if chosen.type == "cuda":
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if (chosen.index or 0) >= count:
            why = (
                f"there are {count} GPUs"
                if count
                else "no GPU is to be seen"
                + ("" if torch.version.cuda else " and this PyTorch is built for the CPU only")
            )
            raise EngineError(
                f"device={name} was asked for, but {why}: use device=auto or device=cpu."
            )
        return torch.device("cuda", chosen.index or 0)
    return chosen


def fit(n_envs, bytes_each, device, what="environments"):
    """EngineError, with the number that fits, if ``n_envs`` things of ``bytes_each`` bytes are too
    many for the memory that is free on ``device``.
    """
    free = free_memory(device)
    if n_envs * bytes_each > 0.95 * free:
        raise EngineError(
            f"{n_envs:,} {what} need {n_envs * bytes_each / 1e9:.1f} GB, but {free / 1e9:.1f} GB "
            f"are free on "
            f"{device}: at most {int(0.95 * free / bytes_each):,} fit."
        )


def free_memory(device):
    """Bytes that can still be allocated on ``device``."""
    device = torch.device(device)
    if device.type == "cuda":
        return (
            torch.cuda.mem_get_info(device)[0]
            + torch.cuda.memory_reserved(device)
            - torch.cuda.memory_allocated(device)
        )
    try:
        with open("/proc/meminfo") as file:
            return next(
                int(line.split()[1]) * 1024 for line in file if line.startswith("MemAvailable")
            )
    except (OSError, StopIteration):
        return 1 << 62


# ---- From tensors to the params of a launch ----


def _pointer(name, tensor, shape, dtype, device):
    """A checked tensor's address; 0 for None."""
    if tensor is None:
        return 0
    if (
        tensor.dtype != dtype
        or tensor.device != device
        or tensor.shape != shape
        or not tensor.is_contiguous()
    ):
        layout = "" if tensor.is_contiguous() else " that is not contiguous"
        raise ValueError(
            f"{name} must be a contiguous {dtype} tensor of shape {tuple(shape)} on {device}, but "
            f"it is a "
            f"{tensor.dtype} one of shape "
            f"{tuple(tensor.shape)} on {tensor.device}{layout}"
        )
    return tensor.data_ptr()


def _scenery_params(scenery, radius):
    layouts = scenery.layouts
    return params.SceneryParams(
        walls=layouts.lines.vals.data_ptr(),
        wall_starts=layouts.wall_starts.data_ptr(),
        texel_starts=layouts.texel_starts.data_ptr(),
        boxes=layouts.boxes.data_ptr(),
        box_starts=layouts.box_starts.data_ptr(),
        texels=layouts.texels.data_ptr(),
        lights=layouts.lights.vals.data_ptr(),
        light_starts=layouts.light_starts.data_ptr(),
        layout=_pointer(
            "scenery.layout", scenery.layout, (scenery.n_envs,), torch.int32, scenery.device
        ),
        model=scenery.model.data_ptr(),
        model_texels=scenery.model_texels.data_ptr(),
        agent_textures=layouts.agent_textures.data_ptr(),
        agent_lines=scenery.agent_lines.data_ptr(),
        agent_light=scenery.agent_light.data_ptr(),
        n_envs=scenery.n_envs,
        n_layouts=len(layouts),
        n_agents=scenery.n_agents,
        n_model=len(scenery.model),
        n_agent_texels=scenery.agent_light.shape[1],
        n_threads=torch.get_num_threads(),
        radius=radius,
        reach=1.001 * scenery.reach,
    )


_STATE = {"positions": (2,), "angles": (), "velocity": (2,), "angvelocity": ()}


def _state(scenery, agents, *names):
    """The addresses of these tensors of the agents, by name."""
    lanes = (scenery.n_envs, scenery.n_agents)
    return {
        name: _pointer(
            f"agents.{name}",
            getattr(agents, name),
            lanes + _STATE[name],
            torch.float32,
            scenery.device,
        )
        for name in names
    }


# By kind, as errors.h numbers them.
_ERRORS = {
    1: "An agent of environment {env} has a position, angle or velocity that is not a finite "
    "number: look at what was last written to it.",
    2: "An agent of environment {env} was given an action that is none of its action space: "
    "actions count from 0.",
    3: "Environment {env} shows a layout that the scenery does not have: ids in scenery.layout "
    "count from 0 and stay below the number of layouts.",
}


def check(agents):
    """EngineError, which names an environment, if since the last check an agent's position, angle
    or velocity was not a finite number, an action was none, or a layout was none. Synchronises
    with the device, so it is not for inside a step.
    """
    flag = int(agents.error_flag)
    if flag:
        agents.error_flag.zero_()
        env, kind = divmod(flag, 4)
        raise EngineError(_ERRORS[kind].format(env=env))


def _checked(agents):
    if agents.error_flag.device.type == "cpu" and int(agents.error_flag):
        check(agents)


# ---- The operations ----


def bake(scenery):
    """Fills ``scenery.layouts.baked``: min(1, 0.1 + sum of 2 I / max(d^2, 1)) over the lights that
    no wall of the layout hides.
    """
    layouts = scenery.layouts
    layouts.update_bounding_boxes()
    texel_wall = torch.repeat_interleave(
        torch.arange(len(layouts.textures), dtype=torch.int32, device=scenery.device),
        layouts.textures.widths,
    )
    wall_layout = torch.repeat_interleave(
        torch.arange(len(layouts), dtype=torch.int32, device=scenery.device), layouts.lines.widths
    )
    packed = params.BakeParams(
        scenery=_scenery_params(scenery, 0.0),
        texel_wall=texel_wall.data_ptr(),
        wall_layout=wall_layout.data_ptr(),
        n_texels=len(texel_wall),
    )
    launch("bake", packed, scenery.device, threads=len(texel_wall))


def physics(scenery, agents, actions=None, moves=None, damping=1.0):
    """Moves the agents by their velocities for 1 / fps seconds, each short of what it meets first:
    a wall, or another agent. Returns a :class:`Physics`.

    If ``actions`` (N, A) int64 are given, each agent first loses the fraction ``damping`` of its
    velocities, and row ``action`` of ``moves`` (n_moves, 3) is added: m/s ahead and left, deg/s.
    """
    n, a = scenery.n_envs, scenery.n_agents
    progress = torch.empty((n, a), device=scenery.device)
    threads_per_env = 8 if n > MANY else 32
    packed = params.PhysicsParams(
        scenery=_scenery_params(scenery, agents.radius),
        **_state(scenery, agents, "positions", "angles", "velocity", "angvelocity"),
        progress=progress.data_ptr(),
        error_flag=agents.error_flag.data_ptr(),
        actions=_pointer("actions", actions, (n, a), torch.int64, scenery.device),
        moves=0 if moves is None else moves.data_ptr(),
        n_moves=0 if moves is None else len(moves),
        retained=1 - damping,
        seconds=1 / agents.fps,
        threads_per_env=threads_per_env,
    )
    launch("physics", packed, scenery.device, threads=threads_per_env * n)
    _checked(agents)
    return Physics(progress)


def update_agent_geometry(scenery, agents, lit=True):
    """Carries the agents' models to where the agents are, and lights their texels."""
    packed = params.UpdateAgentGeometryParams(
        scenery=_scenery_params(scenery, agents.radius),
        **_state(scenery, agents, "positions", "angles"),
        error_flag=agents.error_flag.data_ptr(),
        lit=int(lit),
    )
    threads = WARP * scenery.n_envs * scenery.n_agents
    launch("update_agent_geometry", packed, scenery.device, threads)
    _checked(agents)


# What a view may give; 0: it is not wanted.
_OUTPUTS = dict.fromkeys(
    (
        *("indices", "locations", "dots", "distances", "screen"),
        *("rgb", "depth", "centre_line", "velocity", "angvelocity", "imu"),
        *("seen", "clear_mask", "newly_seen", "n_words"),
    ),
    0,
)


def _render(scenery, agents, subsample=1, max_depth=10.0, **outputs):
    res = agents.res
    half_width = math.tan(math.radians(agents.fov / 2))
    fields = {
        name: value.data_ptr() if isinstance(value, torch.Tensor) else value
        for name, value in outputs.items()
        if value is not None
    }
    packed = params.RenderParams(
        scenery=_scenery_params(scenery, agents.radius),
        **_state(scenery, agents, "positions", "angles"),
        yaws=agents.yaws.data_ptr(),
        ray_lengths=agents.ray_lengths.data_ptr(),
        error_flag=agents.error_flag.data_ptr(),
        n_cameras=len(agents.yaws),
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
    launch("render", packed, scenery.device, threads, shared)
    _checked(agents)


def _cameras(scenery, agents):
    return (scenery.n_envs, scenery.n_agents) + (
        (len(agents.yaws),) if len(agents.yaws) > 1 else ()
    )


def render(scenery, agents):
    """Places the agents' models, lights them, and returns a :class:`Render` of what every camera
    sees.
    """
    update_agent_geometry(scenery, agents)
    shape = _cameras(scenery, agents) + (agents.res,)
    floats = {
        name: torch.empty(shape, device=scenery.device)
        for name in ("locations", "dots", "distances")
    }
    out = Render(
        indices=torch.empty(shape, dtype=torch.int32, device=scenery.device),
        screen=torch.empty((*shape, 3), device=scenery.device),
        **floats,
    )
    _render(scenery, agents, **out._asdict())
    return out


def observe(
    scenery,
    agents,
    subsample=1,
    rgb=True,
    depth=True,
    imu=False,
    centre_line=False,
    seen=None,
    clear_mask=None,
    max_depth=10.0,
):
    """What training needs of a view, in one pass: a fused form of :func:`render` and the sensors of
    :mod:`~megastep.modules`.

    Args: ``subsample`` rays to a pixel, a divisor of res; ``seen`` (N, A, n_words) int32, a bit for
    each static texel of the world's layout, updated in place; ``clear_mask`` (N, A) bool, clears
    ``seen`` first; ``max_depth`` metres. With one agent a world, ``scenery.lines`` is left as it
    was. Returns an :class:`Observation`.
    """
    if not 1 <= subsample <= 32 or agents.res % subsample:
        raise ValueError(
            f"subsample must be at most 32 and divide the {agents.res} rays of a camera, but "
            f"{subsample} was given"
        )
    if not max_depth > 0:
        raise ValueError(
            f"max_depth must be a positive number of metres, but {max_depth} was given"
        )
    n, a, where = scenery.n_envs, scenery.n_agents, scenery.device
    if a > 1:
        update_agent_geometry(scenery, agents, lit=rgb)
    shape, pixels = _cameras(scenery, agents), agents.res // subsample
    out = Observation(
        rgb=torch.empty((*shape, 3, pixels), dtype=torch.float16, device=where) if rgb else None,
        depth=torch.empty((*shape, pixels), dtype=torch.float16, device=where) if depth else None,
        centre_line=torch.empty(shape, dtype=torch.int32, device=where) if centre_line else None,
        imu=torch.empty((n, a, 3), dtype=torch.float16, device=where) if imu else None,
        newly_seen=torch.empty((n, a), dtype=torch.int32, device=where)
        if seen is not None
        else None,
    )
    words = 0 if seen is None else seen.shape[-1]
    most = scenery.layouts.max_texels
    if seen is not None and 32 * words < most:
        raise ValueError(
            f"seen must have a bit for each of a layout's texels, so at least {-(-most // 32)} "
            f"words an agent, "
            f"but it has {words}"
        )
    _render(
        scenery,
        agents,
        subsample,
        max_depth,
        n_words=words,
        **_state(scenery, agents, "velocity", "angvelocity"),
        seen=_pointer("seen", seen, (n, a, words), torch.int32, where),
        clear_mask=_pointer("clear_mask", clear_mask, (n, a), torch.bool, where),
        **out._asdict(),
    )
    return out


def spawn(scenery, agents, mask, points, counts, seed, resample=False):
    """Puts agents at random points of their world's layout, at rest, looking anywhere: one Philox
    draw each.

    Args: ``mask`` (N, A) bool, who; ``points`` (D, n, 2), of which the agents of one world have n /
    A each; ``counts`` (N, A) int32, draws made so far, advanced here; ``resample``: a world all of
    whose agents respawn moves to a random layout first.
    """
    where, lanes = scenery.device, (scenery.n_envs, scenery.n_agents)
    n_layouts, n_points = len(scenery.layouts), points.shape[1]
    if n_points < scenery.n_agents:
        raise ValueError(
            f"{scenery.n_agents} agents need at least as many points, but {n_points} a layout "
            f"were given"
        )
    packed = params.SpawnParams(
        scenery=_scenery_params(scenery, agents.radius),
        **_state(scenery, agents, "positions", "angles", "velocity", "angvelocity"),
        mask=_pointer("mask", mask, lanes, torch.bool, where),
        points=_pointer("points", points, (n_layouts, n_points, 2), torch.float32, where),
        counts=_pointer("counts", counts, lanes, torch.int32, where),
        error_flag=agents.error_flag.data_ptr(),
        key0=seed & 0xFFFFFFFF,
        key1=seed >> 32 & 0xFFFFFFFF,
        n_points=n_points,
        resample=int(resample),
    )
    launch("spawn", packed, where, threads=scenery.n_envs)
    _checked(agents)


def uniform(counts, mask, seed, out):
    """Uniform numbers in [0, 1), four a lane: Philox 4x32-10 with key ``seed`` and counter (lane,
    count).

    Args: ``counts`` (B,) int32, draws each lane has made, advanced by one where ``mask`` (B,) bool;
    ``out`` (B, 4), written where ``mask``.
    """
    n, where = len(counts), out.device
    packed = params.UniformParams(
        counts=_pointer("counts", counts, (n,), torch.int32, where),
        mask=_pointer("mask", mask, (n,), torch.bool, where),
        out=_pointer("out", out, (n, 4), torch.float32, where),
        key0=seed & 0xFFFFFFFF,
        key1=seed >> 32 & 0xFFFFFFFF,
        n_lanes=n,
        n_threads=torch.get_num_threads(),
    )
    launch("uniform", packed, where, threads=n)
    counts.add_(mask)
    return out
