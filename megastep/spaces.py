"""Spaces: the shapes of observations and actions.

A space, or a (nested) dotdict of spaces, describes one lane: its ``shape`` leaves out the leading
axis B. A vector or an image may name the ``dtype`` that it is observed and stored in, such as
``MultiImage(1, 3, 1, 64, dtype=torch.uint8)``; without one it is float16 or float32. It may name
the bounds of its numbers, ``low`` and ``high``, for all or one per channel or dimension; the
contract's checker holds an environment to them, and adapters for other libraries pass them on.

:func:`leaves` and :func:`map` walk trees of spaces. A star import leaves them out, since ``map``
would replace Python's.
"""

import ast
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, NoReturn, cast

import torch

from megastep.arrdict import arrdict

if TYPE_CHECKING:
    from megastep.types import Tree

__all__ = ["MultiContinuous", "MultiDiscrete", "MultiEmpty", "MultiImage", "MultiVector"]

DTYPES = torch.uint8, torch.float16, torch.float32


#: A bound of all numbers of a space, or one for each number of the axis after the agents'.
Bound = float | tuple[float, ...] | None


@dataclass(frozen=True)
class _Space:
    def __post_init__(self) -> None:
        for name, size in self._sizes().items():
            if isinstance(size, bool) or not isinstance(size, int) or size < 1:
                self._refuse(f"needs a positive integer for {name}, not {size!r}")

    def _sizes(self) -> dict[str, int]:
        return {f.name: getattr(self, f.name) for f in fields(self) if f.type is int}

    def _refuse(self, problem) -> NoReturn:
        raise ValueError(f"{type(self).__name__} {problem}")

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of one lane's tensor, without the leading axis B."""
        return tuple(self._sizes().values())


@dataclass(frozen=True)
class _Numbers(_Space):
    dtype: torch.dtype | None = field(default=None, kw_only=True)
    # what checkers and other libraries are told, so no part of what makes two spaces equal
    low: Bound = field(default=None, kw_only=True, compare=False)
    high: Bound = field(default=None, kw_only=True, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in "low", "high":
            bound = getattr(self, name)
            if isinstance(bound, Iterable):
                bound = tuple(float(value) for value in bound)
                if len(bound) != self.shape[1]:
                    self._refuse(f"needs one number for {name}, or {self.shape[1]}, not {bound}")
            elif bound is not None:
                bound = float(bound)
            object.__setattr__(self, name, bound)
        if self.dtype not in (None, *DTYPES):
            allowed = ", ".join(str(dtype) for dtype in DTYPES)
            self._refuse(f"cannot have dtype={self.dtype!r}: allowed are {allowed}")

    def bounds(self, device: torch.device | str | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns (low, high), float32 each, that broadcast with ``shape``; infinite without."""
        axes = (-1, *[1] * (len(self.shape) - 2))
        low = -math.inf if self.low is None else self.low
        high = math.inf if self.high is None else self.high
        low, high = (torch.tensor(bound, device=device).view(axes) for bound in (low, high))
        return low, high

    def __repr__(self) -> str:
        # without a dtype of None and bounds: checkpoints compare spaces as text
        values = self._sizes() | ({"dtype": self.dtype} if self.dtype else {})
        words = ", ".join(f"{name}={value!r}" for name, value in values.items())
        return f"{type(self).__name__}({words})"


@dataclass(frozen=True, repr=False)
class MultiVector(_Numbers):
    """A vector of ``dim`` numbers per agent: shape (n_agents, dim)."""

    n_agents: int
    dim: int


@dataclass(frozen=True, repr=False)
class MultiImage(_Numbers):
    """An image of C channels, H rows and W columns per agent: shape (n_agents, C, H, W)."""

    n_agents: int
    C: int
    H: int
    W: int


@dataclass(frozen=True)
class MultiDiscrete(_Space):
    """An integer from 0 to ``n_actions`` - 1 per agent: shape (n_agents,)."""

    n_agents: int
    n_actions: int

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.n_agents,)


@dataclass(frozen=True)
class MultiContinuous(_Space):
    """``dim`` float32 numbers per agent, within finite bounds: shape (n_agents, dim). A space of
    actions. ``low`` and ``high`` are a number for all or one per dimension, kept as tuples.
    """

    n_agents: int
    dim: int
    low: float | tuple[float, ...] = -1.0
    high: float | tuple[float, ...] = 1.0

    dtype = torch.float32

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in "low", "high":
            given = getattr(self, name)
            values = given if isinstance(given, Iterable) else (given,) * self.dim
            values = tuple(float(value) for value in values)
            if len(values) != self.dim or not all(math.isfinite(value) for value in values):
                self._refuse(
                    f"needs {self.dim} finite numbers for {name}, or one for all, not {given!r}"
                )
            object.__setattr__(self, name, values)
        low, high = cast("tuple", self.low), cast("tuple", self.high)
        if not all(a < b for a, b in zip(low, high)):
            self._refuse(f"needs each low below its high, not {low} and {high}")

    def tensors(
        self, device: torch.device | str | None = None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns (low, high), (dim,) float32 each."""
        return torch.tensor(self.low, device=device), torch.tensor(self.high, device=device)


@dataclass(frozen=True)
class MultiEmpty(_Space):
    """No numbers: shape (0,)."""

    @property
    def shape(self) -> tuple[int, ...]:
        return (0,)


def from_text(text: str) -> _Space:
    """Returns the space whose `repr` a text is. Raises ValueError if it is none."""
    try:
        call = cast("Any", ast.parse(text, mode="eval").body)
        kind = {name: globals()[name] for name in __all__}[call.func.id]
        values = {}
        for word in call.keywords:
            is_dtype = isinstance(word.value, ast.Attribute)
            values[word.arg] = (
                getattr(torch, word.value.attr) if is_dtype else ast.literal_eval(word.value)
            )
        return kind(**values)
    except (SyntaxError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{text!r} is not a space: {error}") from None


def texts(env: Any) -> dict[str, str]:
    """Returns the spaces of an environment or a policy: {'obs.rgb': 'MultiImage(...)', ...}."""
    tree = {"obs": env.obs_space, "actions": env.action_space}
    return {name: repr(space) for name, space in leaves(tree).items()}


def random_actions(
    space: object,
    n_lanes: int,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
    mask: Any = None,
) -> "Tree":
    """Returns uniformly random actions (B, ...) for B lanes, of a space or a (nested) dict of them.
    ``mask``, (B, A, n) bool, or a dict, says which integers are allowed.
    """
    if isinstance(space, Mapping):
        masks = mask or {}
        parts = space.items()
        return arrdict(
            {k: random_actions(one, n_lanes, device, generator, masks.get(k)) for k, one in parts}
        )
    options: dict = dict(device=device, generator=generator)
    leaf = cast("MultiDiscrete | MultiContinuous", space)
    shape = n_lanes, *leaf.shape
    if isinstance(leaf, MultiContinuous):
        low, high = leaf.tensors(device)
        return (low + (high - low) * torch.rand(shape, **options)).clamp(low, high)
    if mask is not None:
        scores = torch.rand((*shape, leaf.n_actions), **options)
        return scores.masked_fill_(~mask.to(scores.device), -1.0).argmax(-1)
    return torch.randint(leaf.n_actions, shape, **options)


def are_actions(space: MultiDiscrete | MultiContinuous, values: torch.Tensor) -> bool:
    """Returns True if all values are actions of a leaf space, whatever their leading axes."""
    if values.shape[-len(space.shape) :] != space.shape:
        return False
    if isinstance(space, MultiContinuous):
        low, high = space.tensors(values.device)
        return values.is_floating_point() and bool(((values >= low) & (values <= high)).all())
    is_integer = not values.is_floating_point()
    return is_integer and bool(((values >= 0) & (values < space.n_actions)).all())


def leaves(space: object, name: str = "") -> dict[str, Any]:
    """Returns the leaves of a tree of spaces by dotted path, or {``name``: the tree}."""
    if not isinstance(space, Mapping):
        return {name: space}
    paths = {}
    for key, child in space.items():
        paths |= leaves(child, f"{name}.{key}" if name else key)
    return paths


def nested(leaves: Mapping[str, Any]) -> Any:
    """Returns the tree of leaves by dotted path: the inverse of :func:`leaves`."""
    if "" in leaves:
        return leaves[""]
    tree = arrdict()
    for path, leaf in leaves.items():
        *keys, last = path.split(".")
        branch = tree
        for key in keys:
            branch = branch.setdefault(key, arrdict())
        branch[last] = leaf
    return tree


def map(function: Callable, space: object, *trees: Any) -> Any:
    """Returns ``function(leaf_space, *leaf_values)`` for each leaf, as an arrdict with the keys of
    the space; of a space that is no dict, the function's result itself. ``trees`` have at least the
    keys of the space.
    """
    if not isinstance(space, Mapping):
        return function(space, *trees)
    return arrdict(
        {key: map(function, child, *(tree[key] for tree in trees)) for key, child in space.items()}
    )
