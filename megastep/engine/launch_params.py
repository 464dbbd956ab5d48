"""The fields that many launches share: tensors' addresses, checked without synchronisation."""

import torch

from megastep.engine import checks, devices
from megastep.engine.agents import Agents
from megastep.engine.scenery import Scenery
from megastep.kernels.build.launch import ENGINE

__all__ = [
    "error_flag_address",
    "lanes_of",
    "scenery_params",
    "seed_params",
    "state_params",
    "texel_bits",
]

_address = torch.Tensor.data_ptr
_n_bytes = torch.Tensor.nbytes.__get__  # pyright: ignore[reportAttributeAccessIssue]


class _Packed:
    """The packed SceneryParams of a scenery, and the addresses and bytes they were packed from.

    Has no ``__dict__``, so that :func:`~megastep.engine.state_tree.state_tree` does not look
    inside.
    """

    __slots__ = ("tensors", "inputs", "params")

    def __init__(self, scenery) -> None:
        layouts = scenery.layouts
        self.inputs: list | None = None
        self.params = b""
        self.tensors = (
            layouts.lines.vals,
            layouts.lights.vals,
            layouts.texels,
            layouts.textures.vals,
            layouts.baked.vals,
            layouts.agent_textures,
            scenery.layout,
            scenery.agent_lines,
            scenery.agent_light,
        )


def scenery_params(scenery: Scenery, radius: float) -> bytes:
    """Returns the packed SceneryParams of a scenery.

    Its tensors cannot be replaced, so they are checked only if the address or size of one has
    changed since the last call. A storage that is resized moves, so its address changes too.

    Raises:
        ValueError: naming the tensor that no longer fits.
    """
    packed = vars(scenery).get("_packed")
    if packed is None:
        packed = vars(scenery)["_packed"] = _Packed(scenery)
    n_threads = devices.threads()
    inputs = [*map(_address, packed.tensors), *map(_n_bytes, packed.tensors), radius, n_threads]
    if packed.inputs != inputs:
        packed.params = _pack(scenery, radius, n_threads)
        packed.inputs = inputs
    return packed.params


def _pack(scenery, radius, n_threads) -> bytes:
    layouts, n, k = scenery.layouts, scenery.n_envs, scenery.n_agent_texels
    n_model = len(scenery.model)

    def address(name, tensor, *shape, dtype=torch.float32) -> int:
        return checks.address(name, tensor, shape, dtype, scenery.device)

    texels = address("scenery.layouts.texels", layouts.texels, layouts.n_texels, 4)
    for name, column in (("textures", 0), ("baked", 3)):
        vals = getattr(layouts, name).vals
        if vals.data_ptr() != texels + column * vals.element_size() * bool(len(vals)):
            raise ValueError(
                f"scenery.layouts.texels and scenery.layouts.{name}.vals must share their memory: "
                f"write into them in place instead of replacing one"
            )
    return ENGINE.params.SceneryParams(
        walls=address("scenery.layouts.lines.vals", layouts.lines.vals, layouts.n_walls, 2, 2),
        wall_starts=layouts.wall_starts,
        texel_starts=layouts.texel_starts,
        boxes=layouts.boxes,
        box_starts=layouts.box_starts,
        texels=texels,
        lights=address("scenery.layouts.lights.vals", layouts.lights.vals, layouts.n_lights, 3),
        light_starts=layouts.light_starts,
        layout=address("scenery.layout", scenery.layout, n, dtype=torch.int32),
        model=scenery.model,
        model_texels=scenery.model_texels,
        agent_textures=address(
            "scenery.layouts.agent_textures", layouts.agent_textures, len(layouts), k, 3
        ),
        agent_lines=address(
            "scenery.agent_lines", scenery.agent_lines, n, scenery.n_agents * n_model, 2, 2
        ),
        agent_light=address("scenery.agent_light", scenery.agent_light, n, k),
        n_envs=n,
        n_layouts=len(layouts),
        n_agents=scenery.n_agents,
        n_model=n_model,
        n_agent_texels=k,
        n_threads=n_threads,
        radius=radius,
        reach=1.001 * scenery.reach,
    )


_STATE = dict(
    positions=("agents.positions", (2,)),
    angles=("agents.angles", ()),
    velocity=("agents.velocity", (2,)),
    angvelocity=("agents.angvelocity", ()),
)


class _Checked:
    """The agents' tensors that were last checked for a scenery: {name: (tensor, memory)}.

    Has no ``__dict__``, as :class:`_Packed`.
    """

    __slots__ = ("scenery", "tensors")

    def __init__(self, scenery) -> None:
        self.scenery, self.tensors = scenery, {}


def state_params(scenery: Scenery, agents: Agents, *names: str) -> dict[str, int]:
    """Returns {name: address} of the agents' tensors ``names``.

    Each is checked only if it is another one than in the last call, or has moved or changed size.

    Raises:
        TypeError, ValueError: naming the first tensor that does not fit the scenery.
    """
    tensors = vars(agents)
    checked = tensors.get("_checked")
    if checked is None or checked.scenery is not scenery:
        checked = tensors["_checked"] = _Checked(scenery)
    addresses = {}
    for name in names:
        tensor, last = tensors[name], checked.tensors.get(name)
        if last is None or tensor is not last[0] or _memory(tensor) != last[1]:
            title, axes = _STATE[name]
            shape = (scenery.n_envs, scenery.n_agents, *axes)
            checks.address(title, tensor, shape, torch.float32, scenery.device)
            last = checked.tensors[name] = tensor, _memory(tensor)
        addresses[name] = last[1][0]
    return addresses


def _memory(tensor) -> tuple[int, int, int]:
    return tensor.data_ptr(), tensor.nbytes, tensor.untyped_storage().nbytes()


def error_flag_address(scenery: Scenery, agents: Agents) -> int:
    """Returns the address of the flag that :func:`~megastep.engine.check` reads."""
    return checks.address("agents.error_flag", agents.error_flag, (1,), torch.int32, scenery.device)


def lanes_of(scenery: Scenery, agents: Agents) -> tuple[int, int]:
    """Returns (N, A), after checking the types of both."""
    checks.instance("scenery", scenery, Scenery)
    checks.instance("agents", agents, Agents)
    return scenery.n_envs, scenery.n_agents


def seed_params(seed: int) -> dict[str, int]:
    """Returns a 64-bit seed as the two words of a generator's key."""
    seed = checks.integer("seed", seed, 0, 2**64 - 1)
    return dict(key0=seed & 0xFFFFFFFF, key1=seed >> 32)


def texel_bits(
    scenery: Scenery, name: str, bits: torch.Tensor, axes: tuple[int, ...]
) -> tuple[int, int]:
    """Returns the address and ``n_words`` of a tensor (*axes, n_words) of texels.

    Raises:
        TypeError, ValueError: naming it, if it does not fit the scenery.
    """
    min_words = -(-scenery.layouts.max_texels // 32)
    n_words = checks.length(name, bits, axis=-1)
    if n_words < min_words:
        raise ValueError(
            f"{name} must have a bit for each of a layout's texels, so at least {min_words} words, "
            f"but it has {n_words}"
        )
    address = checks.address(name, bits, (*axes, n_words), torch.int32, scenery.device)
    return address, n_words
