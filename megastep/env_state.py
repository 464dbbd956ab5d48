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
from typing import Any

import numpy as np
import torch

from megastep.engine.state_tree import OPAQUE, SCALARS, children, node_at, rebind, walk
from megastep.read_only import ReadOnlyTensor

__all__ = ["EnvState"]

_GENERATORS = (torch.Generator, np.random.Generator, np.random.RandomState, random.Random)
_STATEFUL = (torch.Tensor, np.ndarray, *_GENERATORS)
#: Types without attributes that hold nothing that changes.
_CONSTANT = (
    *OPAQUE,
    *(bytes, complex, range, slice, frozenset, type(Ellipsis), enum.Enum, pathlib.PurePath),
    *(torch.Size, torch.layout, torch.memory_format, np.generic, np.dtype, re.Pattern),
)


class EnvState:
    """Saves and restores everything in an environment that changes: tensors, NumPy arrays, random
    generators, and the plain values that have changed since this object was made. A plain value is
    a number, a string, or a list, set or dict of these. The global generators of PyTorch, NumPy and
    Python are saved as well.

    It reaches what attributes, lists and dicts lead to; `unreachable` names the rest. Make it after
    ``env.reset()``.

    Args:
        env: the environment.
    """

    def __init__(self, env: Any):
        self.env, device = env, torch.device(env.device)
        generators = dict(torch=torch.default_generator)
        if device.type == "cuda":
            index = torch.cuda.current_device() if device.index is None else device.index
            generators["cuda"] = torch.cuda.default_generators[index]
        generators |= dict(numpy=np.random.mtrand._rand, python=random.seed.__self__)
        self.root = python_types.SimpleNamespace(env=env, generators=generators)
        self._first_values = copy.deepcopy(self._plain_values())

    def state_dict(self) -> dict[str, dict[str, Any]]:
        """Returns the state by path: tensors, states of generators and plain values. Tensors share
        their memory with the environment.
        """
        arrays, generators = {}, {}
        for path, (_, _, leaf) in walk(self.root, _STATEFUL).items():
            if isinstance(leaf, _GENERATORS):
                generators[path] = _generator_state(leaf)
            elif isinstance(leaf, np.ndarray):
                if leaf.dtype != object:
                    arrays[path] = torch.from_numpy(leaf)
            elif not isinstance(leaf, ReadOnlyTensor):
                arrays[path] = leaf.detach()
        first, missing = self._first_values, object()
        values = self._plain_values()
        values = {path: now for path, now in values.items() if first.get(path, missing) != now}
        lengths = {path: len(node) for path, node in self._nodes_of_user() if _is_list(node)}
        state = {"values": copy.deepcopy(values), "lengths": lengths}
        return {"arrays": arrays, "generators": generators, **state}

    @torch.no_grad()
    def load_state_dict(self, state: dict[str, dict[str, Any]]) -> None:
        """Restores a `state_dict`, whose tensors may be on any device. Tensors change in place, so
        that whatever refers to them sees it.

        Raises:
            ValueError: naming what this environment does not have. Nothing has changed.
        """
        leaves = {path: leaf for path, (_, _, leaf) in walk(self.root, _STATEFUL).items()}
        for path in [*state["arrays"], *state["generators"], *state["values"]]:
            if path not in leaves and node_at(self.root, _parent(path)) is None:
                raise ValueError(
                    f"the state holds {path[1:]}, which this {type(self.env).__name__} does not "
                    "have: its class has changed, or it was made with other arguments"
                )
        for path, value in state["generators"].items():
            if not _set_generator_state(leaves.get(path), value):
                raise ValueError(f"{path[1:]} is no longer the kind of generator that was saved")
        for path, length in state["lengths"].items():
            while len(node_at(self.root, path)) > length:
                node_at(self.root, path).pop()
        fits = {path for path, value in state["arrays"].items() if _fits(leaves.get(path), value)}
        for path in fits:
            torch.as_tensor(leaves[path]).copy_(state["arrays"][path])
        for path, value in state["arrays"].items():
            # what has no such tensor yet, or began as one tensor with another
            if path not in fits or not _equal(leaves[path], value):
                self._replace(path, _like(value, leaves.get(path), self.env.device))
        for path, value in state["values"].items():
            now = node_at(self.root, path)
            is_queue = isinstance(now, collections.deque)
            self._replace(path, collections.deque(value, now.maxlen) if is_queue else value)

    def _replace(self, path, value):
        parent, step = node_at(self.root, _parent(path)), path[len(_parent(path)) :]
        if _is_list(parent) and step == f"[{len(parent)}]":
            parent.append(value)
        else:
            rebind(parent, step, value)

    def unreachable(self) -> list[str]:
        """Returns what may change and cannot be saved, as `name (type)`."""
        names = []
        for path, node in self._nodes_of_user():
            is_opaque = isinstance(node, np.ndarray) and node.dtype == object
            known = (*SCALARS, *_CONSTANT, *_STATEFUL, dict, list, tuple, collections.deque)
            is_reached = isinstance(node, known) or hasattr(node, "__dict__") or _is_plain(node)
            if is_opaque or not is_reached:
                names.append(f"{path.removeprefix('.env.')} ({type(node).__name__})")
        return names

    def _plain_values(self):
        """Returns the plain values by path, without those of megastep's own objects, which never
        change or are addresses.
        """
        nodes = self._nodes_of_user()
        return {
            path: list(node) if isinstance(node, collections.deque) else node
            for path, node in nodes
            if _is_plain(node)
        }

    def _nodes_of_user(self):
        """Yields (path, node) of what is below objects of a class that is not megastep's."""
        visited, stack = set(), [("", self.root, False)]
        while stack:
            path, node, is_users = stack.pop()
            if is_users:
                yield path, node
            if isinstance(node, (*SCALARS, *_CONSTANT, *_STATEFUL)) or id(node) in visited:
                continue
            if is_users and _is_plain(node):
                continue
            visited.add(id(node))
            if hasattr(node, "__dict__"):
                is_users = node is not self.root and not _is_ours(node)
            stack += [(path + step, child, is_users) for step, child in reversed(children(node))]


def _is_ours(node):
    return type(node).__module__.startswith(("megastep.", "torch."))


def _is_list(node):
    return isinstance(node, (list, collections.deque))


def _is_plain(node):
    if isinstance(node, dict):
        return type(node) is dict and _is_plain([*node, *node.values()])
    if isinstance(node, (list, set, collections.deque)):
        return all(isinstance(value, SCALARS) for value in node)
    return isinstance(node, SCALARS)


def _parent(path):
    """Returns a path without its last step."""
    return re.sub(r"(\.[^.\[\]]+|\[('[^']*'|[^\]]*)\])$", "", path)


def _fits(leaf, value):
    """Returns whether a tensor or array can take a saved value in place."""
    if not isinstance(leaf, (torch.Tensor, np.ndarray)):
        return False
    leaf = torch.as_tensor(leaf)
    is_expanded = any(n > 1 and not stride for n, stride in zip(leaf.shape, leaf.stride()))
    return leaf.shape == value.shape and leaf.dtype == value.dtype and not is_expanded


def _equal(leaf, value):
    # as bytes, since NaN is not equal to itself
    pair = (torch.as_tensor(one).cpu().contiguous().view(-1) for one in (leaf, value))
    return torch.equal(*(one.view(torch.uint8) for one in pair))


def _like(value, leaf, device):
    """Returns a saved value as what it takes the place of: a tensor on its device, or an array."""
    if isinstance(leaf, np.ndarray):
        return value.cpu().numpy().copy()
    return value.to(device if leaf is None else leaf.device, copy=True)


def _generator_state(generator):
    if isinstance(generator, torch.Generator):
        return generator.get_state()
    if isinstance(generator, random.Random):
        return generator.getstate()
    if isinstance(generator, np.random.RandomState):
        return _without_arrays(generator.get_state(legacy=False))
    return _without_arrays(generator.bit_generator.state)


def _set_generator_state(generator, state):
    """Returns False if the state is that of another kind of generator."""
    try:
        if isinstance(generator, torch.Generator):
            generator.set_state(state.cpu())
        elif isinstance(generator, random.Random):
            generator.setstate(state)
        elif isinstance(generator, np.random.RandomState):
            generator.set_state(_with_arrays(state))
        else:
            generator.bit_generator.state = _with_arrays(state)
    except (TypeError, ValueError, RuntimeError, AttributeError, KeyError):
        return False
    return True


def _without_arrays(state):
    """Returns the state of one of NumPy's generators as plain values."""
    if isinstance(state, dict):
        return {key: _without_arrays(value) for key, value in state.items()}
    return (state.dtype.name, state.tolist()) if isinstance(state, np.ndarray) else state


def _with_arrays(state):
    if isinstance(state, dict):
        return {key: _with_arrays(value) for key, value in state.items()}
    return np.array(state[1], state[0]) if isinstance(state, tuple) else state
