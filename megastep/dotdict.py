"""Dictionaries with attribute access whose unknown attributes are looked up on their values.

A *tree* is a dict of dicts of ... of leaves; a leaf is anything that is not a dict. Nothing here
needs torch.
"""

import difflib
import functools
from collections.abc import Callable
from typing import Any

__all__ = ["dotdict", "leaves", "mapping"]

_INDENT = 4
_WIDTH = 120
_MAX_AXES = 8  # a tuple of more integers is data, not a shape


class dotdict(dict):
    """A dict whose items are also attributes: ``d.k`` reads ``d['k']``; assign with ``d['k'] = v``.

    An attribute that is neither a method nor a key is looked up on every value, and the answers
    come back in a tree with the same keys. That tree can be called, which calls every leaf:
    ``d.cuda()`` moves a tree of tensors to the GPU. Methods come before keys, keys before the
    values' attributes. A leading underscore is never forwarded.
    """

    __slots__ = ()

    def __getattr__(self, name):
        if name in self:
            return self[name]
        if name.startswith("_"):
            raise AttributeError(_absent(self, name))
        try:
            found = {key: _attribute(value, name) for key, value in self.items()}
        except _Missing as missing:
            raise AttributeError(_absent(self, name, missing.leaf)) from None
        if not leaves(self):
            raise AttributeError(_absent(self, name))
        return type(self)(found)

    def __setattr__(self, name, value):
        raise AttributeError(
            f"{type(self).__name__}s are assigned by key: write d['{name}'] = ..., not d.{name} = "
            f"..."
        )

    def __delattr__(self, name):
        raise AttributeError(
            f"{type(self).__name__}s are deleted from by key: write del d['{name}'], not del "
            f"d.{name}"
        )

    def __missing__(self, key):
        raise KeyError(f"{key!r} is not a key; {_listing(self, key)}")

    def __dir__(self):
        return [*super().__dir__(), *(key for key in self if isinstance(key, str))]

    def __call__(self, *args, **kwargs):
        """Calls every leaf with these arguments; returns the tree of results."""
        return self.map(lambda leaf: leaf(*args, **kwargs))

    def __or__(self, other):
        return type(self)({**self, **other}) if isinstance(other, dict) else NotImplemented

    def __ror__(self, other):
        return type(self)({**other, **self}) if isinstance(other, dict) else NotImplemented

    def copy(self) -> "dotdict":
        """A new tree of the same type holding the same values."""
        return type(self)(self)

    def pipe(self, f: Callable, *args, **kwargs) -> Any:
        """``f(self, ...)``, for calls that read from left to right."""
        return f(self, *args, **kwargs)

    def map(self, f: Callable, *args, **kwargs) -> "dotdict":
        """``f(leaf, ...)`` at every leaf."""
        return _map(lambda leaf: f(leaf, *args, **kwargs), self)

    def starmap(self, f: Callable, *others: dict, **kwargs) -> "dotdict":
        """``f(leaf, other leaf, ...)`` at every leaf, the others being trees with the same keys
        (ValueError if not).
        """
        return _map(functools.partial(f, **kwargs), self, *others)

    def __repr__(self):
        return "\n".join([f"{type(self).__name__}:", *_rows(self)])

    def _repr_pretty_(self, printer, cycle):
        printer.text(f"{type(self).__name__}(...)" if cycle else repr(self))


def leaves(tree: Any) -> list:
    """The leaves of a tree in order, as a list; a bare leaf is its own only one."""
    if isinstance(tree, dict):
        return [leaf for value in tree.values() for leaf in leaves(value)]
    return [tree]


def mapping(f: Callable) -> Callable:
    """Turns ``f(leaf, ...)`` into a function of trees that keeps keys and types. Bare leaves go
    straight to ``f``.
    """

    @functools.wraps(f)
    def mapped(tree, *args, **kwargs):
        return _map(lambda leaf: f(leaf, *args, **kwargs), tree)

    return mapped


def _map(f, tree, *others):
    if not isinstance(tree, dict):
        return f(tree, *others)
    for other in others:
        _check_keys(tree, other)
    return type(tree)(
        {key: _map(f, value, *(other[key] for other in others)) for key, value in tree.items()}
    )


def _check_keys(tree, other):
    if not isinstance(other, dict):
        raise ValueError(
            f"a tree with keys {_names(tree)} was matched with one value of type "
            f"{type(other).__name__}"
        )
    if tree.keys() != other.keys():
        raise ValueError(
            f"two trees must have the same keys, but one has {_names(tree)} and the other "
            f"{_names(other)}"
        )


class _Missing(Exception):
    def __init__(self, leaf):
        self.leaf = leaf


def _attribute(value, name):
    """``value.name``, or for a dict its item of that name, or else the tree of its values'
    attributes.
    """
    if isinstance(value, dict):
        if name in value:
            return value[name]
        return type(value)({key: _attribute(inner, name) for key, inner in value.items()})
    try:
        return getattr(value, name)
    except AttributeError:
        raise _Missing(value) from None


def _names(tree):
    return ", ".join(map(str, tree)) if tree else "none"


def _listing(tree, key):
    near = difflib.get_close_matches(str(key), map(str, tree), n=1)
    return f"its keys are {_names(tree)}" + (f" (did you mean '{near[0]}'?)" if near else "")


def _absent(tree, name, leaf=None):
    values = (
        "" if leaf is None else f", nor an attribute of its values (type {type(leaf).__name__})"
    )
    return f"'{name}' is not a key of this {type(tree).__name__}{values}; {_listing(tree, name)}"


def _rows(tree):
    """One line an item: the key, a gap, and the value; a tree's own items are indented to start
    under its name.
    """
    column = max((len(str(key)) for key in tree), default=0) + _INDENT
    for key, value in tree.items():
        nested = isinstance(value, dict)
        yield f"{key!s:<{column}}" + (
            f"{type(value).__name__}:" if nested else _summary(value, column)
        )
        if nested:
            yield from (" " * column + row for row in _rows(value))


def _summary(value, column):
    """A leaf in one line: arrays by shape and dtype, shapes in full, other collections by their
    length, the rest by their text.
    """
    name = type(value).__name__
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{name}({tuple(value.shape)}, {value.dtype})"
    if _is_shape(value):
        return str(tuple(value))
    if isinstance(value, (list, tuple, set, frozenset)):
        return f"{name}(({len(value)},))"
    text = " ".join(str(value).split())
    room = max(_WIDTH - column, 16)
    return text if len(text) <= room else f"{text[: room - 3]}..."


def _is_shape(value):
    return (
        isinstance(value, tuple)
        and len(value) <= _MAX_AXES
        and all(type(size) is int for size in value)
    )
