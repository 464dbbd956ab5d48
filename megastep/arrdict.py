"""dotdicts of arrays and tensors: they can also be indexed and calculated with, leaf by leaf.

Keys are strings; any other index goes to the leaves. Leaves are tensors, numpy arrays, Raggeds or
plain numbers.
"""

import copy
import operator
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch.utils import _pytree

from megastep.dotdict import _map, dotdict, leaves, mapping

__all__ = ["arrdict", "stack", "cat", "torchify", "numpyify", "clone", "leaves", "mapping"]


class arrdict(dotdict):
    """A :class:`~megastep.dotdict.dotdict` whose indexing and operators act on every leaf.

    ``d[index]`` gives the tree of ``leaf[index]``; ``d[index] = other`` writes into the leaves in
    place, from a tree with the same keys or from one value for all. The other side of an operator
    may be a tree with the same keys, or anything that every leaf can be combined with. Comparisons
    are leaf by leaf too: ``a == b`` is a tree, not a bool.
    """

    __slots__ = ()
    __hash__ = None
    __array_ufunc__ = None  # so that numpy leaves `array + tree` to __radd__

    def __getitem__(self, index):
        if isinstance(index, str):
            return super().__getitem__(index)
        return _combine(operator.getitem, self, index)

    def __setitem__(self, index, value):
        if isinstance(index, str):
            super().__setitem__(index, value)
        elif isinstance(value, dict):
            _map(lambda leaf, new: operator.setitem(leaf, index, new), self, value)
        else:
            _map(lambda leaf: operator.setitem(leaf, index, value), self)


def _combine(op, tree, other):
    if isinstance(other, dict):
        return _map(op, tree, other)
    return _map(lambda leaf: op(leaf, other), tree)


def _forward(op):
    return lambda self, other: _combine(op, self, other)


def _reflected(op):
    return lambda self, other: _combine(lambda leaf, value: op(value, leaf), self, other)


def _unary(op):
    return lambda self: _map(op, self)


def _operators():
    """The special methods of arithmetic, comparison and sign, by name."""
    arithmetic = {
        name: getattr(operator, f"__{name}__")
        for name in (
            "add",
            "sub",
            "mul",
            "matmul",
            "truediv",
            "floordiv",
            "mod",
            "pow",
            "lshift",
            "rshift",
            "and",
            "or",
            "xor",
        )
    }
    for name, op in {**arithmetic, "divmod": divmod}.items():
        yield f"__{name}__", _forward(op)
        yield f"__r{name}__", _reflected(op)
    yield (
        "__ior__",
        _forward(operator.or_),
    )  # dict's own would merge keys; the others have no in-place form
    for name in ("lt", "le", "eq", "ne", "ge", "gt"):
        yield f"__{name}__", _forward(getattr(operator, name))
    for name in ("neg", "pos", "abs", "invert"):
        yield f"__{name}__", _unary(getattr(operator, name))


for _name, _method in _operators():
    setattr(arrdict, _name, _method)


def stack(trees: Iterable, dim: int = 0) -> Any:
    """Joins trees with the same keys along a new axis ``dim``. Numbers are stacked into a numpy
    array.
    """
    return _join("stack", torch.stack, np.stack, trees, dim)


def cat(trees: Iterable, dim: int = 0) -> Any:
    """Joins trees with the same keys along their existing axis ``dim``."""
    return _join("cat", torch.cat, np.concatenate, trees, dim)


def _join(name, torch_join, numpy_join, trees, dim):
    trees = list(trees)
    if not trees:
        raise ValueError(f"{name} was given no trees; it needs one at least")

    def join(*values):
        if isinstance(values[0], torch.Tensor):
            return torch_join(values, dim)
        return numpy_join([np.asarray(value) for value in values], dim)

    return _map(join, *trees)


@mapping
def torchify(leaf: Any) -> Any:
    """Arrays, numbers and Raggeds as CPU tensors. float64, numpy's default, becomes float32; other
    dtypes stay.

    The memory is shared where the dtype stays. Tensors are returned as they are.
    Raises ValueError for what no tensor can hold, such as strings.
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
            f"torchify cannot make a tensor of a value of type {type(leaf).__name__} (dtype "
            f"{array.dtype}); it takes numbers, bools and arrays of them"
        ) from None


@mapping
def numpyify(leaf: Any) -> Any:
    """Tensors and Raggeds as numpy arrays, also those in lists and tuples; anything else is
    returned as it is.

    CPU tensors share their memory with the result. bfloat16, which numpy lacks, becomes float32.
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
def clone(leaf: Any) -> Any:
    """A copy that shares no memory with the original."""
    return leaf.clone() if isinstance(leaf, torch.Tensor) else copy.deepcopy(leaf)


def _register(cls):
    """Makes a tree type known to torch's pytrees, and so to torch.compile, torch.func and their
    like.
    """
    _pytree.register_pytree_node(
        cls,
        lambda tree: (list(tree.values()), list(tree)),
        lambda values, keys: cls(zip(keys, values, strict=True)),
        serialized_type_name=f"{cls.__module__}.{cls.__name__}",
        flatten_with_keys_fn=lambda tree: (
            [(_pytree.MappingKey(k), v) for k, v in tree.items()],
            list(tree),
        ),
    )


_register(dotdict)
_register(arrdict)
