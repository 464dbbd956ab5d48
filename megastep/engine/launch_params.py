"""Launches in a scenery, and the fields that they share: tensors' addresses, checked without
synchronisation.
"""

import ctypes
from dataclasses import dataclass
from typing import Any

import torch

from megastep import devices
from megastep.engine import checks
from megastep.engine.agents import Agents, check
from megastep.engine.scenery import Scenery
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import ENGINE, Blocks, launch

_address = torch.Tensor.data_ptr
#: Axes of the agents' tensors behind (N, A).
_STATE = dict(positions=(2,), angles=(), velocity=(2,), angvelocity=())
POSE, MOTION = ("positions", "angles"), (*_STATE,)


@dataclass(slots=True, eq=False)
class _Cached:
    """What was last computed from a key; without a ``__dict__``, so that no checkpoint has it."""

    key: Any
    value: Any


def scenery_params(scenery: Scenery, radius: float) -> bytes:
    """Returns the packed SceneryParams of a scenery. Its tensors cannot be replaced."""
    n_threads = devices.threads()
    # a copy's tensors lie elsewhere
    key = _address(scenery.layout), _address(scenery.layouts.texels), radius, n_threads
    packed = vars(scenery).get("_packed")
    if packed is not None and packed.key == key:
        return packed.value
    layouts = scenery.layouts
    struct = ENGINE.params.SceneryParams(
        walls=layouts.lines.vals,
        wall_starts=layouts.wall_starts,
        texel_starts=layouts.texel_starts,
        boxes=layouts.boxes,
        box_starts=layouts.box_starts,
        texels=layouts.texels,
        lights=layouts.lights.vals,
        light_starts=layouts.light_starts,
        layout=scenery.layout,
        model=scenery.model,
        model_texels=scenery.model_texels,
        agent_textures=layouts.agent_textures,
        agent_lines=scenery.agent_lines,
        agent_light=scenery.agent_light,
        n_envs=scenery.n_envs,
        n_layouts=len(layouts),
        n_agents=scenery.n_agents,
        n_model=len(scenery.model),
        n_agent_texels=scenery.n_agent_texels,
        n_threads=n_threads,
        radius=radius,
        reach=1.001 * scenery.reach,
    )
    vars(scenery)["_packed"] = _Cached(key, struct)
    return struct


_NO_OBJECTS = bytes(ctypes.sizeof(ENGINE.structs["ObjectsParams"]))


def object_params(scenery: Scenery) -> bytes:
    """Returns the packed ObjectsParams of a scenery, of none if it has no objects."""
    o = scenery.objects
    if o is None:
        return _NO_OBJECTS
    key = _address(o.records), _address(o.palette), _address(o.bodies)
    packed = vars(o).get("_packed")
    if packed is None or packed.key != key:
        same = "shapes", "line_starts", "line_object", "palette", "lines", "texels", "ends"
        same += "bodies", "body_objects", "object_bodies", "n_bodies"
        struct = ENGINE.params.ObjectsParams(
            **{name: getattr(o, name) for name in (*same, "n_objects", "n_colours")},
            extents=scenery.layouts.extents,
            objects=o.records,
            n_lines=len(o.line_object),
            lit=int(o.lit),
            elevated=o.elevated,
        )
        packed = vars(o)["_packed"] = _Cached(key, struct)
    return packed.value


def state_params(scenery: Scenery, agents: Agents, *names: str) -> dict[str, int]:
    """Returns {name: address} of the agents' tensors ``names``. Each is checked only if it is
    another one than in the last call, or has moved: TypeError or ValueError name it.
    """
    tensors = vars(agents)
    checked = tensors.get("_checked")  # {name: (tensor, address)} for a scenery
    if checked is None or checked.key is not scenery:
        checked = tensors["_checked"] = _Cached(scenery, {})
    addresses = {}
    for name in names:
        tensor, (last, address) = tensors[name], checked.value.get(name, (checked, 0))
        if tensor is not last or _address(tensor) != address:
            shape = (scenery.n_envs, scenery.n_agents, *_STATE[name])
            title, device = f"agents.{name}", scenery.device
            address = checks.address(title, tensor, shape, torch.float32, device)
            checked.value[name] = tensor, address
        addresses[name] = address
    return addresses


def launch_in(
    scenery: Scenery,
    agents: Agents,
    operation: str,
    shape: int | Blocks,
    *names: str,
    library: KernelLibrary = ENGINE,
    **fields: object,
) -> None:
    """Launches an operation with the fields ``scenery`` and ``error_flag``, those of
    :func:`state_params` and others. Raises what it flags on a CPU, where nothing synchronises.
    """
    flag = checks.address("agents.error_flag", agents.error_flag, (1,), torch.int32, scenery.device)
    launch(
        *(library, operation, scenery.device, shape),
        scenery=scenery_params(scenery, agents.radius),
        error_flag=flag,
        **state_params(scenery, agents, *names),
        **fields,
    )
    if scenery.device.type == "cpu" and agents.error_flag.item():
        check(agents)


def lanes_of(scenery: Scenery, agents: Agents) -> tuple[int, int]:
    """Returns (N, A), after checking the types of both."""
    checks.instance("scenery", scenery, Scenery)
    checks.instance("agents", agents, Agents)
    return scenery.n_envs, scenery.n_agents


def seed_params(seed: int) -> dict[str, Any]:
    """Returns a 64-bit seed as the two words of a generator's key."""
    seed = checks.integer("seed", seed, 0, 2**64 - 1)
    return dict(key0=seed & 0xFFFFFFFF, key1=seed >> 32)
