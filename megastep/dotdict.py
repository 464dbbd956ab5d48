"""Dictionaries with attribute access, which look up unknown attributes on their values.

A *tree* is a nested dict; a leaf is anything that is not a dict. This file does not import torch.
"""

import difflib
import functools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["dotdict", "leaves", "mapping"]

T = TypeVar("T")


class dotdict(dict):
    """A dict whose items are also attributes: ``d.k`` reads ``d['k']``; assign with ``d['k'] = v``.

    An attribute that is neither a method nor a key is looked up on every value. The results come
    back as a tree with the same keys. Calling a tree calls every leaf, so ``d.cuda()`` moves a tree
    of tensors to the GPU. Names that start with an underscore are not looked up on values.
    """

    __slots__ = ()

    def __getattr__(self, name: str) -> Any:
        if name in self:
            return self[name]
        if name.startswith("_") or not leaves(self):
            raise AttributeError(f"'{name}' is not a key of this {type(self).__name__}")
        try:
            return type(self)({key: _attribute(value, name) for key, value in self.items()})
        except AttributeError as error:
            raise AttributeError(
                f"'{name}' is not a key of this {type(self).__name__} or an attribute of its "
                f"values ({error}); {_listing(self, name)}"
            ) from None

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError(f"write d['{name}'] = ..., not d.{name} = ...")

    def __delattr__(self, name: str) -> NoReturn:
        raise AttributeError(f"write del d['{name}'], not del d.{name}")

    def __missing__(self, key: object) -> NoReturn:
        raise KeyError(f"{key!r} is not a key; {_listing(self, key)}")

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *(key for key in self if isinstance(key, str))]

    def __call__(self, *args: object, **kwargs: object) -> "Self":
        """Calls every leaf with these arguments. Returns the tree of results."""
        return self.map(lambda leaf: leaf(*args, **kwargs))

    def __or__(self, other: dict) -> "Self":
        return type(self)({**self, **other}) if isinstance(other, dict) else NotImplemented

    def __ror__(self, other: dict) -> "Self":
        return type(self)({**other, **self}) if isinstance(other, dict) else NotImplemented

    def copy(self) -> "Self":
        """Returns a new tree of the same type with the same values."""
        return type(self)(self)

    def pipe(self, f: "Callable[..., T]", *args: object, **kwargs: object) -> "T":
        """Returns ``f(self, ...)``, for chains that read from left to right."""
        return f(self, *args, **kwargs)

    def map(self, f: Callable, *args: object, **kwargs: object) -> "Self":
        """Returns the tree of ``f(leaf, ...)``."""
        return _map(lambda leaf: f(leaf, *args, **kwargs), self)

    def starmap(self, f: Callable, *others: dict, **kwargs: object) -> "Self":
        """Returns the tree of ``f(leaf, other_leaf, ...)``. All trees have the same keys."""
        return _map(functools.partial(f, **kwargs), self, *others)

    def __repr__(self) -> str:
        return "\n".join([f"{type(self).__name__}:", *_rows(self)])

    def _repr_pretty_(self, printer, cycle: bool) -> None:
        printer.text(f"{type(self).__name__}(...)" if cycle else repr(self))


def leaves(tree: object) -> list:
    """Returns the list of a tree's leaves in order. A value that is no dict is its own leaf."""
    if isinstance(tree, dict):
        return [leaf for value in tree.values() for leaf in leaves(value)]
    return [tree]


def mapping(f: Callable) -> Callable:
    """Decorates a function of a leaf, ``f(leaf, ...)``, to take trees."""

    @functools.wraps(f)
    def mapped(tree, *args, **kwargs) -> Any:
        return _map(lambda leaf: f(leaf, *args, **kwargs), tree)

    return mapped


def _map(f: Callable, tree, *others) -> Any:
    if not isinstance(tree, dict):
        return f(tree, *others)
    for other in others:
        if not isinstance(other, dict):
            kind = type(other).__name__
            raise ValueError(f"a tree with keys {_names(tree)} needs another tree, not a {kind}")
        if tree.keys() != other.keys():
            raise ValueError(
                f"two trees must have the same keys, but one has {_names(tree)} and the other "
                f"{_names(other)}"
            )
    return type(tree)(
        {key: _map(f, value, *(other[key] for other in others)) for key, value in tree.items()}
    )


def _attribute(value, name: str) -> Any:
    if not isinstance(value, dict):
        return getattr(value, name)
    if name in value:
        return value[name]
    return type(value)({key: _attribute(inner, name) for key, inner in value.items()})


def _names(tree: dict) -> str:
    return ", ".join(map(str, tree)) if tree else "none"


def _listing(tree: dict, key: object) -> str:
    nearest = difflib.get_close_matches(str(key), map(str, tree), n=1)
    hint = f" (did you mean '{nearest[0]}'?)" if nearest else ""
    return f"its keys are {_names(tree)}{hint}"


def _rows(tree: dict) -> Iterator[str]:
    column = max((len(str(key)) for key in tree), default=0) + 4
    for key, value in tree.items():
        if isinstance(value, dict):
            yield f"{key!s:<{column}}{type(value).__name__}:"
            yield from (" " * column + row for row in _rows(value))
        else:
            yield f"{key!s:<{column}}{_summary(value, column)}"


def _summary(value, column: int) -> str:
    name = type(value).__name__
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{name}({tuple(value.shape)}, {value.dtype})"
    is_short = isinstance(value, tuple) and len(value) <= 8  # as a shape is
    if is_short and all(type(size) is int for size in value):
        return str(tuple(value))
    if isinstance(value, (list, tuple, set, frozenset)):
        return f"{name}(({len(value)},))"
    text = " ".join(str(value).split())
    width = max(120 - column, 16)
    return text if len(text) <= width else f"{text[: width - 3]}..."
