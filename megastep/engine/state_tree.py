"""The state of an environment: every tensor and generator reachable from its attributes.

:func:`state_tree` finds them by path, :func:`snapshot` copies them and :func:`restore` writes such
a copy back in place. :mod:`~megastep.capture` does so around the recording of a CUDA graph. The
checkpoints of a run do not hold it: they hold the learner, and a resumed run starts new episodes.
"""

import ast
import types
from typing import Any

import torch

from megastep.read_only import ReadOnlyTensor

__all__ = ["rebind", "restore", "snapshot", "state_tree", "walk"]

State = dict[str, torch.Tensor]

SCALARS = (bool, int, float, str, type(None))
_LEAVES = (torch.Tensor, torch.Generator)
_OPAQUE = (  # what has attributes, but no state of the environment in them
    types.ModuleType,
    types.FunctionType,
    types.MethodType,
    types.BuiltinFunctionType,
    type,
    torch.dtype,
    torch.device,
)


def _children(node):
    """(step of the path, child) of a node of the walk."""
    if isinstance(node, dict):
        return [(f"[{key!r}]", child) for key, child in dict.items(node)]
    if isinstance(node, (list, tuple)):
        return [(f"[{i}]", child) for i, child in enumerate(node)]
    if isinstance(node, torch.nn.Module):
        groups = [getattr(node, group) for group in ("_parameters", "_buffers", "_modules")]
        plain = {key: child for key, child in vars(node).items() if not key.startswith("_")}
        return [(f".{key}", child) for group in (*groups, plain) for key, child in group.items()]
    if hasattr(node, "__dict__"):
        return [(f".{key}", child) for key, child in vars(node).items()]
    return []


def walk(root: Any, wanted: tuple[type, ...]) -> dict[str, tuple[Any, str, Any]]:
    """{path: (parent, step, leaf)} of the leaves of types ``wanted`` below ``root``, each object
    once. Paths read as attributes do, ``.core.agents.positions``; the step is their last part.
    """
    found, seen, stack = {}, set(), [("", None, "", root)]
    while stack:
        path, parent, step, node = stack.pop()
        if isinstance(node, wanted):
            found[path] = (parent, step, node)
        elif not isinstance(node, (*_OPAQUE, *SCALARS, *_LEAVES)) and id(node) not in seen:
            seen.add(id(node))
            stack += [
                (path + below, node, below, child) for below, child in reversed(_children(node))
            ]
    return found


def rebind(parent: Any, step: str, leaf: Any) -> None:
    """Makes ``leaf`` what a node's child at a ``step`` of :func:`walk` is. TypeError or
    AttributeError if the node does not allow it.
    """
    if isinstance(parent, tuple):
        raise TypeError("a tensor inside a tuple was replaced")
    if step.startswith("["):
        parent.__setitem__(ast.literal_eval(step[1:-1]), leaf)
    elif isinstance(parent, torch.nn.Module) and step[1:] in parent._parameters:
        parent._parameters[step[1:]] = leaf
    else:
        setattr(parent, step[1:], leaf)


def state_tree(env: Any) -> dict[str, torch.Tensor | torch.Generator]:
    """{path: tensor or generator} of everything in ``env`` that can change, so without its
    read-only tensors.
    """
    return {
        path: leaf
        for path, (_, _, leaf) in walk(env, _LEAVES).items()
        if not isinstance(leaf, ReadOnlyTensor)
    }


def snapshot(env: Any) -> State:
    """A copy of what :func:`state_tree` finds, for :func:`restore`."""
    return {
        path: leaf.detach().clone() if isinstance(leaf, torch.Tensor) else leaf.get_state()
        for path, leaf in state_tree(env).items()
    }


@torch.no_grad()
def restore(env: Any, saved: State) -> None:
    """Writes a :func:`snapshot` back, in place. ValueError, naming the first, if a leaf is missing
    or differs in shape or dtype.
    """
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
