"""The state of an environment: every tensor and generator reachable from its attributes, for CUDA
graphs (:mod:`~megastep.capture`) and checkpoints (:mod:`~megastep.env_state`).
"""

import ast
import collections
import types as python_types
from typing import Any

import torch

from megastep.read_only import ReadOnlyTensor

State = dict[str, torch.Tensor]

SCALARS = (bool, int, float, str, type(None))
_LEAVES = (torch.Tensor, torch.Generator)
OPAQUE = (  # types whose attributes hold no state of an environment
    python_types.ModuleType,
    python_types.FunctionType,
    python_types.MethodType,
    python_types.BuiltinFunctionType,
    type,
    torch.dtype,
    torch.device,
)


def children(node: object, only_state: bool = True) -> list[tuple[str, Any]]:
    """Returns [(step of the path, child)] of a node. With ``only_state``, an object with
    ``__slots__`` in place of a ``__dict__``, or of a class with ``IS_STATELESS``, has none.
    """
    if only_state and getattr(type(node), "IS_STATELESS", False):
        return []
    if isinstance(node, dict):
        return [(f"[{key!r}]", child) for key, child in dict.items(node)]
    if isinstance(node, (list, tuple, collections.deque)):
        return [(f"[{i}]", child) for i, child in enumerate(node)]
    if isinstance(node, torch.nn.Module):
        groups = [getattr(node, group) for group in ("_parameters", "_buffers", "_modules")]
        plain = {key: child for key, child in vars(node).items() if not key.startswith("_")}
        return [(f".{key}", child) for group in (*groups, plain) for key, child in group.items()]
    below = [(f".{key}", child) for key, child in getattr(node, "__dict__", {}).items()]
    if only_state:
        return below
    # a class without slots may have a base that has some
    slots = [slot for kind in type(node).__mro__ for slot in getattr(kind, "__slots__", ())]
    return below + [(f".{slot}", getattr(node, slot)) for slot in slots if hasattr(node, slot)]


def walk(
    root: object, types: type | tuple[type, ...], only_state: bool = True
) -> dict[str, tuple[Any, str, Any]]:
    """Returns {path: (parent, step, node)} of what is reachable from ``root`` and of one of these
    types. Paths read like attributes, ``.core.agents.positions``; ``step`` is a path's last
    part. An object with children is visited once, by its first path.
    """
    leaves, visited, stack = {}, set(), [("", None, "", root)]
    while stack:
        path, parent, step, node = stack.pop()
        if isinstance(node, types):
            leaves[path] = (parent, step, node)
        if not isinstance(node, (*OPAQUE, *SCALARS, *_LEAVES)) and id(node) not in visited:
            visited.add(id(node))
            below_node = reversed(children(node, only_state))
            stack += [(path + below, node, below, child) for below, child in below_node]
    return leaves


def node_at(root: object, path: str) -> Any:
    """Returns the node at a path of :func:`walk`, None if there is none."""
    node = root
    while path and node is not None:
        below = {step: child for step, child in children(node) if path.startswith(step)}
        step = max(below, key=len, default=None)  # the longest: .limit is a part of .limits
        node, path = (None, path) if step is None else (below[step], path[len(step) :])
    return node


def rebind(parent: Any, step: str, leaf: Any) -> None:
    """Replaces a node's child at a ``step`` of :func:`walk`. TypeError or AttributeError."""
    if isinstance(parent, tuple):
        raise TypeError("a tensor inside a tuple was replaced")
    if step.startswith("["):
        parent.__setitem__(ast.literal_eval(step[1:-1]), leaf)
    elif isinstance(parent, torch.nn.Module) and step[1:] in parent._parameters:
        parent._parameters[step[1:]] = leaf
    else:
        setattr(parent, step[1:], leaf)


def state_tree(env: object) -> dict[str, torch.Tensor | torch.Generator]:
    """Returns {path: tensor or generator} of everything in ``env`` that is not read-only."""
    return {
        path: leaf
        for path, (_, _, leaf) in walk(env, _LEAVES).items()
        if not isinstance(leaf, ReadOnlyTensor)
    }


def snapshot(env: object) -> State:
    """Returns a copy of the state, for :func:`restore`, without tensors that repeat an element
    (``expand``), which nothing changes in place.
    """
    return {
        path: leaf.detach().clone() if isinstance(leaf, torch.Tensor) else leaf.get_state()
        for path, leaf in state_tree(env).items()
        if not is_expanded(leaf)
    }


def is_expanded(leaf: object) -> bool:
    """Returns whether a leaf is a tensor of which several elements are one number in memory."""
    return isinstance(leaf, torch.Tensor) and any(
        n > 1 and not stride for n, stride in zip(leaf.shape, leaf.stride())
    )


@torch.no_grad()
def restore(env: object, saved: State) -> None:
    """Writes a :func:`snapshot` back, in place. ValueError names the first leaf that differs."""
    tree = state_tree(env)
    missing = sorted(saved.keys() - tree.keys())
    if missing:
        raise ValueError(
            f"the state holds {missing[0][1:]}, which this {type(env).__name__} does not have: it "
            f"belongs to another environment or version"
        )
    for path, value in saved.items():
        leaf = tree[path]
        if isinstance(leaf, torch.Generator):
            leaf.set_state(value)
        elif leaf.shape != value.shape or leaf.dtype != value.dtype:
            raise ValueError(
                f"the state's {path[1:]} is {tuple(value.shape)} {value.dtype}, but this "
                f"{type(env).__name__} needs {tuple(leaf.shape)} {leaf.dtype}"
            )
        else:
            leaf.copy_(value)
