"""Resets of some lanes: by a mask, and by a seed. N environments, B lanes."""

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch.utils import _pytree

from megastep.engine import checks
from megastep.engine.state_tree import is_expanded, rebind, walk
from megastep.kernels.build.copies import copy_all
from megastep.read_only import ReadOnlyTensor
from megastep.types import n_lanes

if TYPE_CHECKING:
    from megastep.arrdict import arrdict
    from megastep.types import Env


Integers = TypeVar("Integers", int, torch.Tensor)
COUNTERS = "counts", "n_draws"  # attributes that count a generator's draws
PER_DRAW = "counts", "values"  # may have several rows per environment
MASK32 = 2**32 - 1


class Resets:
    """The ``reset(seed, mask)`` of an environment that begins episodes by a mask. Keeps the last
    world, so that lanes that do not begin keep their rows. The state of the environment is every
    tensor that :func:`~megastep.engine.state_tree.state_tree` finds with N or B rows; draws are
    counted by tensors called ``counts`` or ``n_draws``.

    Args:
        lanes_last: attributes of the environment whose lanes are on the last axis.
        draws: rows that count draws, by the attributes that have them.

    Attributes:
        last: the last world, or None.
        is_used: whether a mask was ever given.
        parts: what an environment made the last ``world``, which is among them, of.
        mask: (B,) bool, lanes whose rows of ``parts`` are written now, in place. None: all, anew.
    """

    __slots__ = ("lanes_last", "draws", "last", "is_used", "parts", "mask")  # so no state

    def __init__(self, lanes_last: tuple[str, ...] = (), draws: Mapping[str, int] | None = None):
        self.lanes_last, self.draws, self.is_used = lanes_last, draws or {}, False
        self.last: arrdict | None = None
        self.parts: dict[str, Any] = {}
        self.mask: torch.Tensor | None = None

    def __reduce__(self) -> tuple:
        return Resets, (self.lanes_last, self.draws)  # a copy has no last world yet

    def keep(self, world: "arrdict") -> "arrdict":
        """Remembers and returns a world. Call it on what ``step`` returns."""
        self.last = self.parts["world"] = world
        return world

    def __call__(
        self,
        env: "Env",
        begin: Callable[[torch.Tensor], "arrdict"],
        seed: int | torch.Tensor | None = None,
        mask: torch.Tensor | None = None,
        begin_in_place: Callable[[torch.Tensor], bool] = lambda mask: False,
    ) -> "arrdict":
        """Begins episodes, as described at ``reset`` of :class:`~megastep.types.Env`. ``begin``
        takes a mask (B,), begins an episode in these lanes, and returns a world. What it does to
        other lanes is undone. ``begin_in_place`` does it to the last world and to no other lane, or
        returns False. TypeError or ValueError name an argument that does not fit.
        """
        everyone = torch.empty(n_lanes(env), dtype=torch.bool, device=env.device)
        world = self.last
        if mask is not None:
            checks.alike("mask", mask, everyone)
            if world is None:
                raise ValueError(
                    "reset(mask=...) leaves the other lanes as they are in the last world, but "
                    "there is none: call reset() first"
                )
            for path, (*_, leaf) in walk(world, torch.Tensor).items():
                if is_expanded(leaf):
                    raise ValueError(
                        f"reset(mask=...) writes single lanes of the last world, but world{path} "
                        "has one number in memory for several (expand): call clone() on it"
                    )
        chosen = everyone.fill_(True) if mask is None else mask
        if seed is not None:
            self._seed(env, seed, chosen)
        if mask is None or world is None:
            self.last = begin(chosen)
            return self.last
        self.is_used = True
        if begin_in_place(chosen):
            return world
        chosen = chosen.clone()  # it may be a part of what changes
        rows, leaves = [*self._rows(env)], _pytree.tree_leaves(world)
        before = copies([*(leaf for _, leaf, _ in rows), *leaves])
        new = begin(chosen)
        began, fresh = new["reset"].clone(), _pytree.tree_leaves(new)
        # in place, so that a CUDA graph that steps and one that resets share the world
        parts, now = [], walk(env, torch.Tensor)
        for path, leaf, axis in rows:
            parent, step, own = now.get(path, (None, "", leaf))
            values = leaf if own is leaf else own.clone()
            if own is not leaf:  # replaced, as by `self.age = self.age + 1`
                try:
                    rebind(parent, step, leaf)
                except (TypeError, AttributeError):  # with its tuple, or frozen dataclass
                    leaf = own
            parts.append((leaf, axis, values))
        parts += [(leaf, 0, own) for leaf, own in zip(leaves, fresh, strict=True)]
        for (leaf, axis, own), old in zip(parts, before, strict=True):
            torch.where(_along(began, env.n_envs, leaf, axis), own, old, out=leaf)
        return world

    def _rows(self, env) -> Iterable[tuple[str, torch.Tensor, int]]:
        """Yields (path, tensor, axis of lanes or environments) of what an episode may change."""
        sizes = env.n_envs, n_lanes(env)
        for path, (_, step, leaf) in walk(env, torch.Tensor).items():
            if isinstance(leaf, ReadOnlyTensor) or is_expanded(leaf) or not leaf.ndim:
                continue
            if path.removeprefix(".") in self.lanes_last:
                yield path, leaf, -1
            elif len(leaf) in sizes:
                yield path, leaf, 0
            elif step[1:] in PER_DRAW and len(leaf) and len(leaf) % env.n_envs == 0:
                yield path, leaf, 0

    def _seed(self, env, seed, chosen) -> None:
        seeds = torch.empty_like(chosen, dtype=torch.int64)
        if isinstance(seed, torch.Tensor):
            start = _first_draw(checks.alike("seed", seed, seeds))
        else:
            start = seeds.fill_(_first_draw(checks.integer("seed", seed, 0, 2**63 - 1)))
        leaves = walk(env, torch.Tensor).values()
        found = [leaf for _, step, leaf in leaves if step[1:] in COUNTERS]
        found += [getattr(env, name)[row] for name, row in self.draws.items()]
        for counter in found:
            places = _along(chosen, env.n_envs, counter, 0)
            starts = _along(start, env.n_envs, counter, 0)
            counter.copy_(torch.where(places, starts.to(counter.dtype), counter))


def copies(leaves: list[torch.Tensor]) -> list[torch.Tensor]:
    """Returns copies of tensors, on a GPU by one kernel."""
    pairs = [(torch.empty_like(leaf), leaf) for leaf in leaves]
    copy_all(pairs)
    return [copy for copy, _ in pairs]


def _first_draw(seed: Integers) -> Integers:
    """Returns where a seed begins in each generator: the last step of MurmurHash3, 30 bits."""
    x = (seed ^ (seed >> 32)) & MASK32
    x = ((x ^ (x >> 16)) * 0x85EBCA6B) & MASK32
    x = ((x ^ (x >> 13)) * 0xC2B2AE35) & MASK32
    return (x ^ (x >> 16)) & (2**30 - 1)


def _along(values, n_envs, leaf, axis) -> torch.Tensor:
    """Returns values (B,) shaped for a leaf with rows of lanes or of environments: any lane's."""
    n_rows = leaf.shape[axis]
    if n_rows != len(values):
        by_env = values.view(n_envs, -1)
        by_env = by_env.any(1) if values.dtype == torch.bool else by_env[:, 0]
        values = by_env.repeat_interleave(n_rows // n_envs, output_size=n_rows)
    return values if axis else values.view(-1, *[1] * (leaf.ndim - 1))
