"""The state of an environment for checkpoints: what :mod:`~megastep.engine.state_tree` finds, and
what the environments of users keep besides tensors.
"""

import collections
import copy
import enum
import pathlib
import random
import re
import types as python_types
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch

from megastep.arrdict import arrdict
from megastep.engine.resets import Resets
from megastep.engine.state_tree import OPAQUE, children, is_expanded, node_at, rebind, walk
from megastep.read_only import ReadOnlyTensor
from megastep.types import Env

__all__ = ["EnvState", "way_back"]

GENERATORS = (torch.Generator, np.random.Generator, np.random.RandomState, random.Random)
_STATEFUL = (torch.Tensor, np.ndarray, *GENERATORS)
_SCALARS = (bool, int, float, str, type(None), complex, bytes, enum.Enum, np.generic)
_LISTS = (list, collections.deque)
_CONTAINERS = (*_LISTS, tuple, dict, set, frozenset)
#: Bytes of a tensor that is left out if it has not changed.
LARGE = 2**20
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
    NumPy and Python are saved as well, and so is the last world of an environment whose lanes were
    reset by a mask.

    Tensors of a MB and more that have not changed since, such as floor plans, are left out: a new
    environment of the same settings has them.

    It reaches what attributes, lists and dicts lead to, also of a bot that plays in it;
    `unreachable` names the rest. Make it after ``env.reset()``.
    """

    knows_large = True

    def __init__(self, env: Env, bot: object = None):
        self.env, device = env, torch.device(env.device)
        generators = dict(torch=torch.default_generator)
        if device.type == "cuda":
            index = torch.cuda.current_device() if device.index is None else device.index
            generators["cuda"] = torch.cuda.default_generators[index]
        generators |= dict(numpy=np.random.mtrand._rand, python=random.seed.__self__)
        self.root = python_types.SimpleNamespace(env=env, bot=bot, generators=generators)
        self._first_values, self._first_digests = {}, {}
        for path, node, is_users in self._nodes():
            if _is_writable(node):
                if self.knows_large and node.nbytes >= LARGE:
                    self._first_digests[path] = _digest(node)
            elif is_users and _is_plain(node):
                self._first_values[path] = "value", _encoded(node)

    def state_dict(self) -> dict[str, dict[str, Any]]:
        """Returns the state. Tensors share their memory with the environment; all else is a copy,
        in types that `torch.load(weights_only=True)` reads.
        """
        records, firsts = self._records(), self._first_values
        records = {p: one for p, one in records.items() if p not in firsts or one != firsts[p]}
        worlds = {
            path: _tree(dict, resets.last, lambda leaf: leaf)
            for path, resets in self._resets()
            if resets.is_used and resets.last is not None
        }
        return dict(records=records, worlds=worlds)

    def _records(self) -> dict[str, tuple]:
        """Returns {path: (kind of node, what `_load` needs)} of everything, parents first."""
        records, first_paths = {}, {}
        for path, node, is_users in self._nodes():
            if _is_writable(node):
                first = first_paths.setdefault(_identity(node), path) if node.numel() else path
                digest = self._first_digests.get(path)
                if first != path:
                    records[path] = "same", first
                elif digest is not None and _digest(node) == digest:
                    records[path] = "unchanged", digest
                else:
                    records[path] = "tensor", node.detach(), node.device.type
            elif isinstance(node, GENERATORS):
                records[path] = "generator", _generator_state(node)
            elif isinstance(node, np.ndarray) and _is_savable(node.dtype):
                data = torch.from_numpy(np.frombuffer(node.tobytes(), np.uint8).copy())
                records[path] = "array", data, node.dtype.str, node.shape
            elif is_users and _is_plain(node):
                records[path] = "value", _encoded(node)
            elif is_users and isinstance(node, _LISTS):
                records[path] = "list", len(node)
            elif is_users and isinstance(node, dict) and _is_plain([*node]):
                records[path] = "dict", _encoded([*node])
        return records

    def _resets(self) -> Iterator[tuple[str, Resets]]:
        return ((path, leaf) for path, (_, _, leaf) in walk(self.root, Resets).items())

    # ---- Restoring ----

    def load_state_dict(self, state: dict[str, dict[str, Any]]) -> None:
        """Restores a `state_dict`, whose tensors may be on any device. Tensors change in place, so
        that whatever refers to them sees it. If it raises ValueError, since the state does not fit,
        nothing has changed.
        """
        before = {
            path: (record[0], record[1].clone(), *record[2:]) if record[0] == "tensor" else record
            for path, record in self._records().items()
        }
        try:
            self._load(state["records"])
        except Exception as error:
            self._load(before)
            raise ValueError(
                f"the state of {type(self.env).__name__} does not fit: {error}"
            ) from error
        for path, resets in self._resets():  # a world of another state would mislead a masked reset
            world = state["worlds"].get(path)
            resets.is_used = world is not None
            resets.last = world and _tree(
                arrdict, world, lambda leaf: leaf.to(self.env.device, copy=True)
            )

    @torch.no_grad()
    def _load(self, records) -> None:
        written = set()
        for path, record in records.items():
            now = node_at(self.root, path)
            match record:
                case "list", length:
                    now = now if isinstance(now, _LISTS) else self._replace(path, [])
                    while len(now) > length:
                        now.pop()
                case "dict", keys:
                    now = now if isinstance(now, dict) else self._replace(path, {})
                    for key in now.keys() - {*_decoded(keys)}:
                        del now[key]
                case "value", value:
                    if _encoded(now) != value:
                        self._set_value(path, now, _decoded(value))
                case "generator", state:
                    is_of_another_device = path.startswith(".generators") and now is None
                    if not is_of_another_device and not _set_generator_state(now, state):
                        raise ValueError(
                            f"{name_of(path)} is no longer the kind of generator it was"
                        )
                case "unchanged", digest:
                    if not isinstance(now, torch.Tensor) or _digest(now) != digest:
                        raise ValueError(
                            f"{name_of(path)} is not that of the run; did its homes or class "
                            "change?"
                        )
                case "same", first:
                    if _identity(now) != _identity(same := node_at(self.root, first)):
                        self._replace(path, same)
                case "array", data, dtype, shape:
                    array = np.frombuffer(data.cpu().numpy().tobytes(), dtype).reshape(shape).copy()
                    is_array = isinstance(now, np.ndarray) and now.flags.writeable
                    if is_array and (now.dtype, now.shape) == (array.dtype, array.shape):
                        now[...] = array
                    else:
                        self._replace(path, array)
                case "tensor", value, device:
                    self._set_tensor(path, now, value, device, written)

    def _set_value(self, path, now, value) -> None:
        if type(now) is type(value) and _is_plain(now) and now == value:
            return  # it may be in a tuple
        if type(now) is type(value) and isinstance(now, (*_LISTS, dict, set)):
            now.clear()
            (now.extend if isinstance(now, _LISTS) else now.update)(value)
        else:
            self._replace(path, type(now)[value] if isinstance(now, enum.Enum) else value)

    def _set_tensor(self, path, now, value, device, written) -> None:
        """Writes into a tensor, or replaces one of another shape, or that is `written` already."""
        is_tensor = isinstance(now, torch.Tensor) and not is_expanded(now)
        is_alike = is_tensor and (now.shape, now.dtype) == (value.shape, value.dtype)
        is_new = _identity(now) not in written
        if is_alike and (is_new or torch.equal(*map(as_bytes, (now, value)))):
            now.copy_(value)
            written.add(_identity(now))
            return
        owner = node_at(self.root, _parent(path))
        is_fixed = isinstance(now, torch.Tensor) and _is_ours(owner) and not isinstance(owner, dict)
        if is_fixed and now.shape != value.shape:  # of another version of megastep
            shapes = f"was {tuple(value.shape)} and is {tuple(now.shape)}"
            raise ValueError(f"the shape of {name_of(path)} {shapes}")
        device = device if torch.cuda.is_available() else "cpu"
        self._replace(path, value.to(device, copy=True))

    def _replace(self, path, value) -> Any:
        parent, step = node_at(self.root, _parent(path)), path[len(_parent(path)) :]
        if parent is None:
            raise ValueError(f"it has no {name_of(path)}")
        if isinstance(parent, _LISTS) and step == f"[{len(parent)}]":
            parent.append(value)
        else:
            rebind(parent, step, value)
        return value

    # ---- What there is ----

    def unreachable(self) -> list[str]:
        """Returns what may change and cannot be saved, as `name (type)`."""
        return [
            f"{name_of(path)} ({type(node).__name__})"
            for path, node, is_users in self._nodes()
            if is_users and not _is_reached(node)
        ]

    def _nodes(self) -> Iterator[tuple[str, Any, bool]]:
        """Yields (path, node, whether it is below an object of a class that is not megastep's)."""
        visited, stack = set(), [("", self.root, False)]
        while stack:
            path, node, is_users = stack.pop()
            yield path, node, is_users
            is_leaf = isinstance(node, (*_SCALARS, *_CONSTANT, *_STATEFUL))
            if is_leaf or id(node) in visited or (is_users and _is_plain(node)):
                continue
            visited.add(id(node))
            if hasattr(node, "__dict__"):
                is_users = node is not self.root and not _is_ours(node)
            stack += [(path + step, child, is_users) for step, child in reversed(children(node))]


def way_back(env: Env) -> Callable[[], None]:
    """Returns a function that sets an environment back to where it is now."""
    state = EnvState(env)
    state._first_values, state._first_digests = {}, {}  # nothing is left out
    first = copy.deepcopy(state.state_dict())
    return lambda: state.load_state_dict(first)


def _tree(kind, tree, function) -> Any:
    """Returns a tree whose dicts are of another kind, with ``function(leaf)`` of each leaf."""
    if not isinstance(tree, dict):
        return function(tree)
    return kind({key: _tree(kind, part, function) for key, part in tree.items()})


def as_bytes(tensor) -> torch.Tensor:
    return tensor.detach().cpu().contiguous().view(-1).view(torch.uint8)


def _is_writable(node) -> bool:
    is_tensor = isinstance(node, torch.Tensor) and not isinstance(node, ReadOnlyTensor)
    return is_tensor and node.layout == torch.strided


def _is_ours(node) -> bool:
    kind = type(node)
    is_ours = kind.__module__.startswith(("megastep.", "torch."))
    return is_ours and not getattr(kind, "HAS_PLAIN_STATE", False)


def _is_reached(node) -> bool:
    if isinstance(node, np.ndarray):
        return _is_savable(node.dtype)
    known = (Resets, *_STATEFUL, *_CONSTANT, *_LISTS, tuple, dict)
    return isinstance(node, known) or _is_plain(node) or hasattr(node, "__dict__")


def _is_plain(node) -> bool:
    if type(node) in _CONTAINERS:
        parts = [*node, *node.values()] if type(node) is dict else node
        return all(map(_is_plain, parts))
    return isinstance(node, _SCALARS)


def _is_savable(dtype) -> bool:
    return dtype.kind in "biufcSUmM"


def _parent(path) -> str:
    """Returns a path without its last step."""
    return re.sub(r"(\.[^.\[\]]+|\[('[^']*'|[^\]]*)\])$", "", path)


def name_of(path) -> str:
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


# ---- Plain values and generators, in types that a file without code can hold ----


def _encoded(value) -> Any:
    """Returns a plain value in types that JSON-like files hold; others as ("$type", ...)."""
    if isinstance(value, (np.generic, np.ndarray, complex)):
        value = np.asarray(value)
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
    kinds = (list, tuple)
    if kind := next((kind for kind in kinds if isinstance(value, kind)), None):
        return kind(map(_encoded, value))
    kinds = (bool, int, float, str)  # of which others derive
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
