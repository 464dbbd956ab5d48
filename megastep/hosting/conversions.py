"""Converts Gymnasium's spaces to megastep's, each with a function that converts its values.

N environments, one agent each; `...` the shape of a Gymnasium space.
"""

import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

import numpy as np
import torch
from torch import nn

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.dotdict import dotdict
from megastep.types import Space

#: The fewest rows and columns of an image, those of one of floats without an axis for channels, and
#: the channels up to which any array with so many rows and columns is an image.
MIN_SIDE, MIN_FLOAT_SIDE, FEW_CHANNELS = 8, 16, 4
CURE = "env.wrappers=[package.module:Wrapper]"
#: Names that no part of a space can have: attributes of the trees and modules whose keys they are.
RESERVED = {*dir(arrdict), *dir(nn.ModuleDict())}

#: A space of ours, and the function that converts a batch of values.
Conversion = tuple[Space, Callable[[Any], Any]]


def observation(space: Any, path: str = "observation") -> Conversion:
    """Returns the observation space for one of Gymnasium's, and a function from a batch of its
    values, (N, ...), to ours, (N, *space.shape) per leaf. ValueError: no encoder takes a leaf.
    """
    from gymnasium import spaces as gym

    if isinstance(space, (gym.Dict, gym.Tuple)):
        tree, parts = _parts(space, observation, path)
        return tree, lambda values: arrdict(
            {name: convert(values[key]) for name, key, convert in parts}
        )
    if isinstance(space, gym.Discrete):
        return spaces.MultiDiscrete(1, int(space.n)), lambda x: (x - space.start)[:, None]
    if isinstance(space, gym.MultiDiscrete):
        if len({*space.nvec.flat}) > 1:
            tree, convert = observation(_as_tuple(space), path)
            return tree, lambda x: convert(x.reshape(len(x), -1).T)
        whole = spaces.MultiDiscrete(space.nvec.size, int(space.nvec.flat[0]))
        return whole, lambda x: (x - space.start).reshape(-1, space.nvec.size)
    if not isinstance(space, (gym.Box, gym.MultiBinary)) or 0 in space.shape:
        raise ValueError(
            f"{path} is {_described(space)}, which no encoder takes; give it a wrapper that drops "
            f"or encodes it: {CURE}"
        )
    return _image(space) or (
        spaces.MultiVector(1, math.prod(space.shape), dtype=torch.float32),
        lambda x: x.reshape(len(x), 1, -1),
    )


def actions(space: Any, path: str = "action") -> Conversion:
    """Returns the action space for one of Gymnasium's, and a function from our actions,
    (N, *space.shape) per leaf, to a batch of its values, (N, ...). ValueError: none chooses a leaf.
    """
    from gymnasium import spaces as gym

    if isinstance(space, (gym.Dict, gym.Tuple)):
        tree, parts = _parts(space, actions, path)

        def batch(values) -> dict | tuple:
            converted = {key: convert(values[name]) for name, key, convert in parts}
            return converted if isinstance(space, gym.Dict) else (*converted.values(),)

        return tree, batch
    dtype, shape = space.dtype, (-1, *(space.shape or ()))
    if isinstance(space, gym.Discrete):
        whole = spaces.MultiDiscrete(1, int(space.n))
        return whole, lambda x: (x[:, 0] + space.start).astype(dtype)
    if isinstance(space, gym.MultiBinary):
        whole = spaces.MultiDiscrete(math.prod(space.shape), 2)
        return whole, lambda x: x.reshape(shape).astype(dtype)
    if isinstance(space, gym.MultiDiscrete):
        if len({*space.nvec.flat}) > 1:
            tree, convert = actions(_as_tuple(space), path)
            return tree, lambda x: np.stack(convert(x), 1).reshape(shape).astype(dtype)
        whole = spaces.MultiDiscrete(space.nvec.size, int(space.nvec.flat[0]))
        return whole, lambda x: (x.reshape(shape) + space.start).astype(dtype)
    if not isinstance(space, gym.Box) or 0 in space.shape:
        raise ValueError(
            f"{path} is {_described(space)}, which no output chooses; give it a wrapper that "
            f"replaces it: {CURE}"
        )
    low, high = space.low, space.high
    with np.errstate(over="ignore"):
        extent = high.astype(np.float32) - low.astype(np.float32)
    if not np.isfinite(extent).all() or not (extent > 0).all():
        raise ValueError(
            f"{path} is {_described(space)}, and actions need finite bounds, each low below its "
            "high, between which float32 has numbers; give it a wrapper with a narrower space: "
            f"{CURE}"
        )
    bounds = (tuple(float(bound) for bound in side.flat) for side in (low, high))
    rounded = np.rint if np.issubdtype(dtype, np.integer) else np.asarray
    return (
        spaces.MultiContinuous(1, low.size, *bounds),
        # float32 may have rounded beyond a bound of float64
        lambda x: np.clip(rounded(x.reshape(shape)), low, high).astype(dtype),
    )


def _image(space) -> Conversion | None:
    """Returns the conversion of a Box that is an image or a stack of images, None if it is not:
    with the same bounds everywhere, unlike vectors, or marked by a wrapper as ``is_image``.
    """
    if getattr(space, "is_image", False):
        return spaces.MultiImage(1, *space.shape, dtype=torch.uint8), lambda x: x[:, None]
    if type(space).__name__ != "Box" or len(space.shape) not in (2, 3, 4):
        return None
    is_uint8, shape = space.dtype == np.uint8, space.shape
    is_uniform = is_uint8 or all((x == x.flat[0]).all() for x in (space.low, space.high))
    dtype = torch.uint8 if is_uint8 else torch.float32
    if len(shape) == 2:
        is_bounded = is_uint8 or (is_uniform and np.isfinite([space.low, space.high]).all())
        if not is_bounded or min(shape) < (MIN_SIDE if is_uint8 else MIN_FLOAT_SIDE):
            return None
        return spaces.MultiImage(1, 1, *shape, dtype=dtype), lambda x: x[:, None, None]
    is_last = _has_channels_last(shape[-3:], is_uniform)
    if is_last is None or (math.prod(shape[:-3]) > 1 and not is_uniform):
        return None

    def convert(x) -> np.ndarray:
        x = np.moveaxis(x, -1, -3) if is_last else x
        return x.reshape(len(x), 1, -1, *x.shape[-2:])

    _, _, *sizes = convert(np.empty((1, *shape), bool)).shape
    return spaces.MultiImage(1, *sizes, dtype=dtype), convert


def _has_channels_last(shape, is_uniform) -> bool | None:
    """Returns which axis of an image has its channels: False for the first, None if none."""
    first, middle, last = shape
    can_be_last, can_be_first = min(first, middle) >= MIN_SIDE, min(middle, last) >= MIN_SIDE
    if can_be_last and last <= FEW_CHANNELS:
        return True
    if can_be_first and first <= FEW_CHANNELS:
        return False
    if not is_uniform or not (can_be_last or can_be_first):
        return None
    if can_be_last and can_be_first and (first == middle) == (middle == last):
        return last <= first
    return first == middle if can_be_last and can_be_first else can_be_last


def _parts(space, conversion, path) -> tuple[dotdict, list[tuple[str, object, Callable]]]:
    """Returns the space of a Dict or Tuple, and [(our name, Gymnasium's key, function)]."""
    children = space.spaces if isinstance(space.spaces, Mapping) else dict(enumerate(space.spaces))
    tree, parts = dotdict(), []
    for name, (key, child) in zip(identifiers(children), children.items()):
        tree[name], convert = conversion(child, f"{path}[{key!r}]")
        parts.append((name, key, convert))
    return tree, parts


def _as_tuple(space) -> Any:
    """Returns choices of different numbers of options one by one."""
    from gymnasium.spaces import Discrete, Tuple

    pairs = zip(space.nvec.flat, space.start.flat)
    return Tuple([Discrete(int(n), start=int(start)) for n, start in pairs])


def identifiers(keys: Iterable[object], reserved: Collection[str] = RESERVED) -> list[str]:
    """Returns a name for each key: `a-b` becomes a_b, 0 becomes part_0, `type` becomes type_."""
    names = []
    for key in keys:
        name = re.sub(r"\W", "_", str(key))
        name = name if name.isidentifier() else f"part_{name}"
        while name in names or name in reserved:
            name += "_"
        names.append(name)
    return names


def _described(space) -> str:
    text = " ".join(str(space).split())
    is_short = type(space).__name__ == "Box" and len(text) <= 80
    return text if is_short else f"a {type(space).__name__}"
