"""The state of an environment for checkpoints: what :mod:`~megastep.engine.state_tree` finds, and
what the environments of users keep besides tensors.
"""

import collections
import contextlib
import enum
import functools
import inspect
import pathlib
import random
import re
import types as python_types
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.engine.resets import Resets
from megastep.engine.state_tree import OPAQUE, children, is_expanded, node_at, rebind, walk
from megastep.read_only import ReadOnlyTensor
from megastep.types import Env

__all__ = ["EnvState"]

_GENERATORS = (torch.Generator, np.random.Generator, np.random.RandomState, random.Random)
_STATEFUL = (torch.Tensor, np.ndarray, *_GENERATORS)
_NUMBERS = (bool, int, float, str, type(None), complex, bytes, enum.Enum, np.generic)
_CONTAINERS = (list, tuple, dict, set, frozenset, collections.deque)
#: Bytes of a tensor that is left out if it has not changed.
_LARGE = 2**20
_UNEQUAL = object()
_CHUNK, _FACTOR = 2**20, 0x9E3779B1  # an odd number without a pattern
#: Types without attributes that hold nothing that changes.
_CONSTANT = (
    *OPAQUE,
    *(range, slice, type(Ellipsis), pathlib.PurePath, torch.Size, torch.layout),
    *(torch.memory_format, np.dtype, re.Pattern),
)


class EnvState:
    """Saves and restores everything in an environment that changes: tensors, NumPy arrays, random
    generators, and the plain values that have changed since this object was made. A plain value is
    a number, a string, or lists, tuples, sets and dicts of these. The global generators of PyTorch,
    NumPy and Python are saved as well.

    The last world of an environment whose lanes were reset by a mask is saved too.

    Tensors of a MB and more that have not changed since, such as floor plans, are left out: a new
    environment of the same settings has them.

    It reaches what attributes, lists and dicts lead to; `unreachable` names the rest. Make it after
    ``env.reset()``.

    Args:
        env: the environment.
        bot: a policy that plays in it and may have a state of its own, or None.
        host_only: it is used for `host_state` only, so no large tensor is read.
    """

    def __init__(self, env: Env, bot: object = None, host_only: bool = False):
        self.env, device = env, torch.device(env.device)
        generators = dict(torch=torch.default_generator)
        if device.type == "cuda":
            index = torch.cuda.current_device() if device.index is None else device.index
            generators["cuda"] = torch.cuda.default_generators[index]
        generators |= dict(numpy=np.random.mtrand._rand, python=random.seed.__self__)
        self.root = python_types.SimpleNamespace(env=env, bot=bot, generators=generators)
        self._first_values, self._first_digests = {}, {}
        for path, node, is_users in self._nodes():
            if isinstance(node, torch.Tensor) and not isinstance(node, ReadOnlyTensor):
                if not host_only and node.nbytes >= _LARGE:
                    self._first_digests[path] = _digest(node)
            elif is_users and _is_plain(node):
                self._first_values[path] = "value", _encoded(node)

    # ---- Saving ----

    def state_dict(self) -> dict[str, dict[str, Any]]:
        """Returns the state. Tensors share their memory with the environment; all else is a copy,
        in types that `torch.load(weights_only=True)` reads.
        """
        records, first_values = self._records(), self._first_values
        records = {p: one for p, one in records.items() if one != first_values.get(p, _UNEQUAL)}
        worlds = {
            path: spaces.leaves(resets.last)
            for path, resets in self._resets()
            if resets.is_used and resets.last is not None
        }
        return dict(records=records, worlds=worlds)

    def _records(self) -> dict[str, tuple]:
        """Returns {path: record} of everything, parents before children. A record is the kind of a
        node and what `_load` needs to have it again.
        """
        records, first_paths = {}, {}
        for path, node, is_users in self._nodes():
            if isinstance(node, torch.Tensor) and not isinstance(node, ReadOnlyTensor):
                first = first_paths.setdefault(_identity(node), path) if node.numel() else path
                digest = self._first_digests.get(path)
                if first != path:
                    records[path] = "same", first
                elif digest is not None and _digest(node) == digest:
                    records[path] = "unchanged", digest
                else:
                    records[path] = "tensor", node.detach(), node.device.type
            elif record := _record(node, is_users):
                records[path] = record
        return records

    def _resets(self) -> Iterator[tuple[str, Resets]]:
        return ((path, leaf) for path, (_, _, leaf) in walk(self.root, Resets).items())

    def host_state(self) -> dict[str, tuple]:
        """Returns the part of the state that no CUDA graph repeats, for `restore_host`: what is not
        in tensors, and tensors and generators on the CPU where the environment is on a GPU.
        """
        records = {}
        is_on_gpu = torch.device(self.env.device).type == "cuda"
        for path, node, is_users in self._nodes():
            is_frozen = is_on_gpu and getattr(node, "device", None) == torch.device("cpu")
            with contextlib.suppress(TypeError, ValueError, RuntimeError):  # of rare kinds
                if isinstance(node, torch.Generator):
                    records[path] = "generator", node.get_state(), is_frozen
                elif not isinstance(node, torch.Tensor):
                    records[path] = _record(node, is_users)
                elif is_frozen and node.nbytes < _LARGE and not isinstance(node, ReadOnlyTensor):
                    records[path] = "frozen", _bytes(node)
        return records

    def restore_host(self, state: dict[str, tuple]) -> None:
        """Restores a `host_state` in the same process, but for the lengths of lists and what is
        frozen. Of plain values, those that have changed.
        """
        now, kinds = self.host_state(), ("value", "array", "generator")
        records = {path: record for path, record in state.items() if record and record[0] in kinds}
        self._load(
            {
                path: record
                for path, record in records.items()
                if record[0] != "value" or repr(now.get(path)) != repr(record)
            }
        )

    def changed_on_host(self, before: dict[str, tuple]) -> str | None:
        """Returns the name of something that has changed since an earlier `host_state` and that no
        CUDA graph repeats: a plain value, an array, the length of a list, a generator of NumPy or
        Python, and a tensor or a generator on the CPU where the environment is on a GPU. None if
        there is none, or all objects are megastep's own.
        """
        if not any(is_users for *_, is_users in self._nodes()):
            return None
        was, now = _comparable(before), _comparable(self.host_state())
        changed = sorted(path for path in {*was, *now} if was.get(path) != now.get(path))
        if not changed:
            return None
        is_global = re.match(r"\.generators\['(\w+)'\]", changed[0])
        return f"the global generator of {is_global[1]}" if is_global else _name(changed[0])

    # ---- Restoring ----

    def load_state_dict(self, state: dict[str, dict[str, Any]]) -> None:
        """Restores a `state_dict`, whose tensors may be on any device. Tensors change in place, so
        that whatever refers to them sees it.

        Raises:
            ValueError: it does not fit this environment. Nothing has changed.
        """
        before = {
            path: (record[0], record[1].clone(), *record[2:]) if record[0] == "tensor" else record
            for path, record in self._records().items()
        }
        try:
            if "records" not in state:
                raise ValueError("it is of another version of megastep")
            self._load(state["records"])
        except Exception as error:
            self._load(before)
            raise ValueError(
                f"the state of {type(self.env).__name__} does not fit: {error}"
            ) from error
        for path, resets in self._resets():  # a world of another state would mislead a masked reset
            leaves, device = state.get("worlds", {}).get(path), torch.device(self.env.device)
            resets.is_used = leaves is not None
            resets.last = leaves and _tree({k: v.to(device, copy=True) for k, v in leaves.items()})

    @torch.no_grad()
    def _load(self, records) -> None:
        written = set()
        for path, (kind, value, *more) in records.items():
            now = node_at(self.root, path)
            if kind == "list":
                now = now if _is_list(now) else self._replace(path, [])
                while len(now) > value:
                    now.pop()
            elif kind == "dict":
                now, keys = (
                    now if isinstance(now, dict) else self._replace(path, {}),
                    _decoded(value),
                )
                for key in [key for key in now if key not in keys]:
                    del now[key]
            elif kind == "object":
                if now is None:
                    raise ValueError(f"it has no {_name(path)}")
                if type(now).__qualname__ != value:
                    found = type(now).__qualname__
                    raise ValueError(f"{_name(path)} was a {value} and is a {found}")
            elif kind == "value":
                self._set_value(path, now, _decoded(value))
            elif kind == "generator":
                is_of_another_device = path.startswith(".generators") and now is None
                if not is_of_another_device and not _set_generator_state(now, value):
                    raise ValueError(f"{_name(path)} is no longer the kind of generator it was")
            elif kind == "unchanged":
                if not isinstance(now, torch.Tensor) or _digest(now) != value:
                    raise ValueError(
                        f"{_name(path)} is not that of the run; did its homes or class change?"
                    )
            elif kind == "same":
                if _identity(now) != _identity(same := node_at(self.root, value)):
                    self._replace(path, same)
            elif kind == "array":
                dtype, shape = more
                array = np.frombuffer(value.cpu().numpy().tobytes(), dtype).reshape(shape)
                self._set_array(path, now, array.copy())
            else:
                self._set_tensor(path, now, value, more[0], written)

    def _set_value(self, path, now, value) -> None:
        if isinstance(now, enum.Enum):
            self._replace(path, type(now)[value])
        elif isinstance(now, (list, collections.deque)) and type(now) is type(value):
            now.clear()
            now.extend(value)
        elif isinstance(now, (dict, set)) and type(now) is type(value):
            now.clear()
            now.update(value)
        else:
            self._replace(path, value)

    def _set_array(self, path, now, array) -> None:
        is_alike = isinstance(now, np.ndarray) and (now.dtype, now.shape) == (
            array.dtype,
            array.shape,
        )
        if is_alike and now.flags.writeable:
            now[...] = array
        else:
            self._replace(path, array)

    def _set_tensor(self, path, now, value, device, written) -> None:
        """Writes into a tensor, or replaces what is none of this shape yet, or began as one with
        another, which is in `written`.
        """
        is_tensor = isinstance(now, torch.Tensor) and not is_expanded(now)
        is_alike = is_tensor and (now.shape, now.dtype) == (value.shape, value.dtype)
        if is_alike and (_identity(now) not in written or _equal(now, value)):
            now.copy_(value)
            written.add(_identity(now))
            return
        owner = node_at(self.root, _parent(path))
        is_fixed = isinstance(now, torch.Tensor) and _is_ours(owner) and not _is_dict(owner)
        if is_fixed and now.shape != value.shape:  # of another version of megastep
            shapes = f"was {tuple(value.shape)} and is {tuple(now.shape)}"
            raise ValueError(f"the shape of {_name(path)} {shapes}")
        device = device if torch.cuda.is_available() else "cpu"
        self._replace(path, value.to(device, copy=True))

    def _replace(self, path, value) -> Any:
        parent, step = node_at(self.root, _parent(path)), path[len(_parent(path)) :]
        if parent is None:
            raise ValueError(f"it has no {_name(path)}")
        if not _is_state(self.root, parent, step, value):
            raise ValueError(f"{_name(path)} is not state of the environment")
        if _is_list(parent) and step == f"[{len(parent)}]":
            parent.append(value)
        else:
            rebind(parent, step, value)
        return value

    # ---- What there is ----

    def unreachable(self) -> list[str]:
        """Returns what may change and cannot be saved, as `name (type)`."""
        return [
            f"{_name(path)} ({type(node).__name__})"
            for path, node, is_users in self._nodes()
            if is_users and not _is_reached(node)
        ]

    def _nodes(self) -> Iterator[tuple[str, Any, bool]]:
        """Yields (path, node, whether it is below an object of a class that is not megastep's).
        Plain values of megastep's own objects never change, or are addresses.
        """
        visited, stack = set(), [("", self.root, False)]
        while stack:
            path, node, is_users = stack.pop()
            yield path, node, is_users
            is_leaf = isinstance(node, (*_NUMBERS, *_CONSTANT, *_STATEFUL))
            if is_leaf or id(node) in visited or (is_users and _is_plain(node)):
                continue
            visited.add(id(node))
            if hasattr(node, "__dict__"):
                is_users = node is not self.root and not _is_ours(node)
            stack += [(path + step, child, is_users) for step, child in reversed(children(node))]


def _record(node, is_users) -> tuple | None:
    """Returns the record of a node that is no tensor, None if it has none."""
    if isinstance(node, _GENERATORS):
        return "generator", _generator_state(node)
    if isinstance(node, np.ndarray):
        is_savable = _is_savable(node.dtype)
        return ("array", _as_bytes(node), node.dtype.str, node.shape) if is_savable else None
    if not is_users or isinstance(node, torch.Tensor):
        return None
    if _is_plain(node):
        return "value", _encoded(node)
    if _is_list(node):
        return "list", len(node)
    if _is_dict(node):
        return "dict", _encoded([*node])
    return ("object", type(node).__qualname__) if _is_object(node) else None


def _tree(leaves) -> arrdict:
    """Returns the tree of leaves by dotted path."""
    tree = arrdict()
    for path, leaf in leaves.items():
        *above, name = path.split(".")
        node = tree
        for key in above:
            node = node.setdefault(key, arrdict())
        node[name] = leaf
    return tree


def _comparable(host_state) -> dict[str, object]:
    """Returns {path: what is equal for equal values}."""
    same = {}
    for path, record in host_state.items():
        kind = record and record[0]
        if kind == "array":
            same[path] = record[1].numpy().tobytes()
        elif kind == "list":
            same[f"{path} (its length)"] = record[1]
        elif kind == "generator" and isinstance(record[1], torch.Tensor):
            if record[2]:
                same[path] = _bytes(record[1])
        elif kind in ("value", "generator", "frozen"):
            same[path] = repr(record[1])
    return same


def _bytes(tensor) -> bytes:
    return tensor.detach().contiguous().view(-1).view(torch.uint8).numpy().tobytes()


def _is_ours(node) -> bool:
    kind = type(node)
    is_ours = kind.__module__.startswith(("megastep.", "torch."))
    return is_ours and not getattr(kind, "HAS_PLAIN_STATE", False)


def _is_state(root, parent, step, value) -> bool:
    """Returns whether a step from a node leads to what may be replaced by a saved value: files may
    come from strangers, and name methods.
    """
    now = dict(children(parent)).get(step)
    if parent is root or (_is_ours(parent) and _is_plain(value) and not _is_dict(parent)):
        return False
    if not isinstance(now, (*_STATEFUL, *_NUMBERS, *_CONTAINERS)):
        return False
    if step.startswith("["):
        return True
    name = step[1:]
    of_class = inspect.getattr_static(type(parent), name, None)
    kinds = (*_STATEFUL, *_NUMBERS, *_CONTAINERS, functools.cached_property)
    is_data = isinstance(of_class, kinds)
    return is_data and not (name.startswith("__") and name.endswith("__"))


def _is_reached(node) -> bool:
    if isinstance(node, np.ndarray):
        return _is_savable(node.dtype)
    known = (Resets, *_STATEFUL, *_CONSTANT, list, tuple, dict, collections.deque)
    return isinstance(node, known) or _is_plain(node) or hasattr(node, "__dict__")


def _is_object(node) -> bool:
    return hasattr(node, "__dict__") and not isinstance(node, (*_STATEFUL, *_CONSTANT))


def _is_list(node) -> bool:
    return isinstance(node, (list, collections.deque))


def _is_dict(node) -> bool:
    return isinstance(node, dict) and _is_plain([*node])


def _is_plain(node) -> bool:
    if type(node) in _CONTAINERS:
        parts = [*node, *node.values()] if type(node) is dict else node
        return all(map(_is_plain, parts))
    return isinstance(node, _NUMBERS)


def _is_savable(dtype) -> bool:
    return dtype.kind in "biufcSUmM"


def _as_bytes(array) -> torch.Tensor:
    """Returns a copy of an array's bytes, (n,) uint8."""
    return torch.from_numpy(np.frombuffer(array.tobytes(), np.uint8).copy())


def _parent(path) -> str:
    """Returns a path without its last step."""
    return re.sub(r"(\.[^.\[\]]+|\[('[^']*'|[^\]]*)\])$", "", path)


def _name(path) -> str:
    return path.removeprefix(".env").lstrip(".")


def _identity(leaf) -> object:
    """Returns what is equal for tensors that are the same."""
    if not isinstance(leaf, torch.Tensor):
        return id(leaf)
    return leaf.device, leaf.data_ptr(), leaf.shape, leaf.stride(), leaf.dtype


def _digest(tensor) -> int:
    """Returns a number that differs if a tensor has other bytes or these in another order."""
    data = tensor.detach().contiguous().view(-1).view(torch.uint8)
    data = data.view(torch.int32) if len(data) % 4 == 0 else data
    factors = torch.arange(1, _CHUNK + 1, device=data.device) * _FACTOR
    factors = factors.to(torch.int32) | 1  # odd, so each bit counts
    total = torch.zeros((), dtype=torch.int64, device=data.device)
    for chunk in data.split(_CHUNK):  # all modulo a power of 2
        total = total * _FACTOR + (chunk * factors[: len(chunk)]).sum(dtype=torch.int64)
    return int(total)


def _equal(leaf, value) -> bool:
    # as bytes, since NaN is not equal to itself
    pair = (one.detach().cpu().contiguous().view(-1) for one in (leaf, value))
    return torch.equal(*(one.view(torch.uint8) for one in pair))


# ---- Plain values and generators, in types that a file without code can hold ----


def _encoded(value) -> Any:
    """Returns a plain value or a generator's state as numbers, strings, lists, dicts and tuples,
    those of other types as tuples that begin with the type's name.
    """
    if isinstance(value, (np.generic, np.ndarray)):
        return "$numpy", value.dtype.str, value.shape, value.tobytes().hex()
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, dict):
        return {_encoded(key): _encoded(part) for key, part in value.items()}
    if isinstance(value, collections.deque):
        return "$deque", [*map(_encoded, value)], value.maxlen
    if isinstance(value, (set, frozenset)):
        return f"${type(value).__name__}", (*sorted(map(_encoded, value), key=repr),)
    if isinstance(value, bytes):
        return "$bytes", value.hex()
    if isinstance(value, complex):
        return "$complex", value.real, value.imag
    kinds = (list, tuple)
    if kind := next((kind for kind in kinds if isinstance(value, kind)), None):
        return kind(map(_encoded, value))
    kinds = (bool, int, float, str)
    return next((kind(value) for kind in kinds if isinstance(value, kind)), value)


def _decoded(value) -> Any:
    match value:
        case ("$numpy", dtype, shape, text):
            array = np.frombuffer(bytes.fromhex(text), dtype).reshape(shape)
            return array.copy() if shape else array[()]
        case ("$deque", parts, length):
            return collections.deque(map(_decoded, parts), length)
        case ("$set" | "$frozenset" as name, parts):
            return (set if name == "$set" else frozenset)(map(_decoded, parts))
        case ("$bytes", text):
            return bytes.fromhex(text)
        case ("$complex", real, imaginary):
            return complex(real, imaginary)
        case dict():
            return {_decoded(key): _decoded(part) for key, part in value.items()}
        case list() | tuple():
            return type(value)(map(_decoded, value))
    return value


def _generator_state(generator) -> Any:
    if isinstance(generator, torch.Generator):
        return generator.get_state()
    if isinstance(generator, random.Random):
        return generator.getstate()
    if isinstance(generator, np.random.RandomState):
        return _encoded(generator.get_state(legacy=False))
    return _encoded(generator.bit_generator.state)


def _set_generator_state(generator, state) -> bool:
    """Returns False if the state is that of another kind of generator."""
    try:
        if isinstance(generator, torch.Generator):
            generator.set_state(state.cpu())
        elif isinstance(generator, random.Random):
            generator.setstate(state)
        elif isinstance(generator, np.random.RandomState):
            generator.set_state(_decoded(state))
        else:
            generator.bit_generator.state = _decoded(state)
    except (TypeError, ValueError, RuntimeError, AttributeError, KeyError):
        return False
    return True
