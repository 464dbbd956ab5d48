"""Trees of arrays and tensors, with indexing and arithmetic on every leaf.

Keys are strings; any other index goes to the leaves. Leaves are tensors, numpy arrays, Raggeds or
numbers.
"""

import copy
import functools
import operator
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from torch.utils import _pytree

from megastep.dotdict import _map, dotdict, leaves, mapping

__all__ = ["arrdict", "stack", "cat", "torchify", "numpyify", "clone", "leaves", "mapping"]


class arrdict(dotdict):
    """A :class:`~megastep.dotdict.dotdict` whose indexing and operators act on every leaf.

    - ``d[index]`` returns the tree of ``leaf[index]``.
    - ``d[index] = other`` writes into the leaves in place. ``other`` is a tree with the same keys,
      or one value for all leaves.
    - ``d + other`` and other operators return a tree. ``other`` is a tree with the same keys, or
      anything that can be combined with every leaf.
    - ``a == b`` compares leaf by leaf: it returns a tree, not a bool.
    """

    __slots__ = ()
    __hash__ = None
    __array_ufunc__ = None  # makes numpy leave `array + tree` to __radd__

    def __getitem__(self, index) -> Any:
        if isinstance(index, str):
            return super().__getitem__(index)
        return _combine(operator.getitem, self, index)

    def __setitem__(self, index, value) -> None:
        if isinstance(index, str):
            super().__setitem__(index, value)
        elif isinstance(value, dict):
            _map(lambda leaf, new: operator.setitem(leaf, index, new), self, value)
        else:
            _map(lambda leaf: operator.setitem(leaf, index, value), self)


def _combine(op: Callable, tree: dict, other) -> Any:
    if isinstance(other, dict):
        return _map(op, tree, other)
    return _map(lambda leaf: op(leaf, other), tree)


_UNARY = "neg", "pos", "abs", "invert"
_COMPARISONS = "lt", "le", "eq", "ne", "ge", "gt"
_ARITHMETIC = "add sub mul matmul truediv floordiv mod pow lshift rshift and or xor divmod".split()
for _name in (*_ARITHMETIC, *_COMPARISONS, *_UNARY):
    _op = divmod if _name == "divmod" else getattr(operator, f"__{_name}__")
    if _name in _UNARY:
        setattr(arrdict, f"__{_name}__", lambda self, *, op=_op: _map(op, self))
        continue
    setattr(arrdict, f"__{_name}__", lambda self, other, *, op=_op: _combine(op, self, other))
    if _name in _ARITHMETIC:
        _op = functools.partial(lambda op, leaf, value: op(value, leaf), _op)
        setattr(arrdict, f"__r{_name}__", lambda self, other, *, op=_op: _combine(op, self, other))
# dict has |=, which merges keys, and no other
arrdict.__ior__ = lambda self, other: _combine(operator.or_, self, other)


def stack(trees: Iterable, dim: int = 0) -> Any:
    """Joins trees with the same keys along a new axis ``dim``. Numbers become a numpy array."""
    return _join(torch.stack, np.stack, trees, dim)


def cat(trees: Iterable, dim: int = 0) -> Any:
    """Joins trees with the same keys along an existing axis ``dim``."""
    return _join(torch.cat, np.concatenate, trees, dim)


def _join(torch_join: Callable, numpy_join: Callable, trees: Iterable, dim: int) -> Any:
    def join(*values) -> np.ndarray | torch.Tensor:
        if isinstance(values[0], torch.Tensor):
            return torch_join(values, dim)
        return numpy_join([np.asarray(value) for value in values], dim)

    first, *others = trees
    return _map(join, first, *others)


@mapping
def torchify(leaf: Any) -> torch.Tensor:
    """Converts arrays, numbers and Raggeds to CPU tensors. Tensors are returned unchanged. float64,
    numpy's default, becomes float32; other dtypes stay, and share memory with the result.
    """
    if isinstance(leaf, torch.Tensor):
        return leaf
    if hasattr(leaf, "torchify"):
        return leaf.torchify()
    array = np.asarray(leaf)
    if array.dtype == np.float64:
        array = array.astype(np.float32)
    try:
        return torch.as_tensor(array)
    except TypeError:
        raise ValueError(
            f"torchify cannot convert a {type(leaf).__name__} (dtype {array.dtype}) to a tensor; "
            f"it takes numbers, bools and arrays of them"
        ) from None


@mapping
def numpyify(leaf: Any) -> object:
    """Converts tensors and Raggeds to numpy arrays, also in lists and tuples; other leaves stay.
    CPU tensors share memory with the result. bfloat16, which numpy lacks, becomes float32.
    """
    if isinstance(leaf, torch.Tensor):
        leaf = leaf.detach().cpu()
        return (leaf.float() if leaf.dtype == torch.bfloat16 else leaf).numpy()
    if hasattr(leaf, "numpyify"):
        return leaf.numpyify()
    if isinstance(leaf, (list, tuple)):
        items = [numpyify(item) for item in leaf]
        return type(leaf)(*items) if hasattr(leaf, "_fields") else type(leaf)(items)
    return leaf


@mapping
def clone(leaf: object) -> object:
    """Returns a copy that shares no memory with the original."""
    return leaf.clone() if isinstance(leaf, torch.Tensor) else copy.deepcopy(leaf)


def _flattened(tree: Any) -> tuple[list, list]:
    return [(_pytree.MappingKey(key), value) for key, value in tree.items()], list(tree)


# with torch's pytrees, for torch.compile, torch.func and others
for _kind in (dotdict, arrdict):
    _pytree.register_pytree_node(
        _kind,
        lambda tree: (list(tree.values()), list(tree)),
        lambda values, keys, kind=_kind: kind(zip(keys, values, strict=True)),
        serialized_type_name=f"{_kind.__module__}.{_kind.__name__}",
        flatten_with_keys_fn=_flattened,
    )
