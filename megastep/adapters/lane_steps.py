"""An environment as other libraries step it: resets of single lanes, copies that stay valid, and
conversions. N environments, B lanes.
"""

import itertools
import math
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import cast

import numpy as np
import torch
from torch.utils._pytree import tree_flatten, tree_unflatten

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.capture import Graph, capture
from megastep.dotdict import leaves, mapping
from megastep.engine.resets import copies
from megastep.kernels.build.copies import MAX_BYTES, copy_bytes, either
from megastep.types import Env, Tree, World, n_lanes, optional, takes_masks

WORD = 16  # bytes
BLOCK_BYTES, BLOCK_ROWS = 2**27, 32  # at most, of copies that share memory


def ended(world: World) -> torch.Tensor:
    """Returns (B,) bool: where a world ends an episode."""
    return either(world["terminal"], world["truncated"])


@torch.inference_mode(False)
@torch.no_grad()
def fresh(tree: Tree) -> Tree:
    """Returns a copy of a tree of tensors: for one, memory of its own for each is quickest."""
    return mapping(torch.clone)(tree)


class Copies:
    """Copies of a tree of contiguous tensors on a GPU. A kernel, which may be part of a CUDA graph,
    copies all into the next row of a block, whose address and a 0 are in ``row``, (2,) int64. Views
    are made for a whole block, which they keep, since each takes PyTorch as long as copying. With
    ``to_numpy`` blocks are page-locked memory, into which the kernel writes over the bus.
    """

    def __init__(self, tree: Tree, row: torch.Tensor, to_numpy: bool):
        self._tree, self._leaves, self._row, self._to_numpy = tree, leaves(tree), row, to_numpy
        ends = itertools.accumulate(-(-leaf.nbytes // WORD) * WORD for leaf in self._leaves)
        *self._starts, self._row_bytes = 0, *ends
        self._blank: list[tuple] = []  # views of the rows that are left
        self._is_taken = True  # what the kernel wrote last

    def prepare(self, n_rows: int = BLOCK_ROWS) -> None:
        """Call it before the kernel. Makes at most ``n_rows`` rows if there is none."""
        is_ready, self._is_taken = self._blank and self._is_taken, False
        if not is_ready:  # none is left, or a call was interrupted
            self._blank = self._block(min(max(BLOCK_BYTES // self._row_bytes, 1), n_rows))

    @torch.inference_mode(False)  # they may be called in one, whose tensors stay in it
    @torch.no_grad()
    def _block(self, n_rows) -> list[tuple]:
        if self._to_numpy:  # what an interrupted call has begun to write
            torch.cuda.current_stream(self._row.device).synchronize()
        where: dict = dict(pin_memory=True) if self._to_numpy else dict(device=self._row.device)
        block = torch.empty((n_rows, self._row_bytes), dtype=torch.uint8, **where)
        views = [
            block[:, start : start + x.nbytes].view(x.dtype).view(n_rows, *x.shape)
            for start, x in zip(self._starts, self._leaves)
        ]
        self._row.zero_()
        self._row[0].fill_(block.data_ptr())
        rows = (view.numpy() if self._to_numpy else view.unbind() for view in views)
        return [*zip(*rows)][::-1]

    def write(self) -> None:
        """Launches the kernel."""
        copy_bytes([*zip(self._starts, self._leaves)], row=self._row, row_bytes=self._row_bytes)

    def take(self) -> Tree:
        """Returns what the kernel wrote last, for which it waits if these are arrays."""
        views = self._blank.pop()
        self._is_taken = True
        if self._to_numpy:
            torch.cuda.current_stream(self._row.device).synchronize()
        return _unflattened(self._tree, iter(views))


def _unflattened(tree, rest) -> Tree:
    """Returns a tree of dicts with other leaves."""
    if not isinstance(tree, dict):
        return next(rest)
    return {key: _unflattened(value, rest) for key, value in tree.items()}


#: The last that began to reset or step each environment, by the environment's id.
_LATEST: "weakref.WeakValueDictionary[int, Lanes]" = weakref.WeakValueDictionary()


class Lanes:
    """Steps an environment, until others begin to. On a GPU steps are CUDA graphs, and worlds
    are valid until the next step or reset.

    Args:
        same_step: begin a new episode in the step that ends one, by a masked reset.
        purpose: what needs masked resets, for the message; None if nothing does.
        parts: what of a step's result, a tree of tensors, ``copies`` has after it on a GPU.
        to_numpy: whether ``copies`` are arrays.
    """

    @torch.inference_mode(False)
    def __init__(
        self,
        env: Env,
        same_step: bool = False,
        purpose: str | None = None,
        parts: Callable[[World, World, torch.Tensor], Tree] | None = None,
        to_numpy: bool = False,
    ):
        self.env, self.n_lanes, self.device = env, n_lanes(env), torch.device(env.device)
        self.roots: tuple = (env,)  # what a step changes
        self._takes_masks = takes_masks(env)
        self._advance = self._same_step if same_step else self._next_step
        self._on_gpu = self.device.type == "cuda" and optional(env, "capturable")
        self._source = torch.device("cpu") if to_numpy and self._on_gpu else self.device
        self._reset = cast(Callable, env.reset)
        self._step: Callable | None = None
        self._resets: dict[int, Callable] = {}  # by their number of arguments
        self.copies: Copies | None = None
        self._parts, self._to_numpy = parts, to_numpy
        self._row = torch.empty(2, dtype=torch.int64, device=self.device)
        if purpose:
            self._require_masks(purpose)
        self._is_replaced = False

    def _require_own(self) -> None:
        if self._is_replaced:
            text = "was given to another adapter since; make an environment for each"
            raise ValueError(f"this {type(self.env).__name__} {text}")
        if (older := _LATEST.get(id(self.env))) is not self:
            if older:
                older._is_replaced = True  # both would write into one last world
            _LATEST[id(self.env)] = self

    def _require_masks(self, purpose) -> None:
        if not self._takes_masks:
            raise ValueError(
                f"{purpose} needs reset(seed=None, mask=None), which {type(self.env).__name__} "
                "does not have; docs/new-environment.md says under The contract what it does"
            )

    @torch.inference_mode(False)
    @torch.no_grad()
    def reset(self, seed: int | Sequence[int | None] | None = None, mask: Tree = None) -> World:
        """Returns the first world, or with a mask (B,) bool of lanes that begin, the last one with
        new rows. Lane 0 has the seed, the next the next seed; or there is one per lane. An episode
        depends on the seed and the lane.
        """
        self._require_own()
        if seed is not None or mask is not None:
            self._require_masks("a seed or a mask")
        elif not self._takes_masks:
            return self.env.reset()
        seeds, mask = self._seeds(seed), self._mask(mask)
        if not isinstance(self._step, Graph):
            return self._reset(seed=seeds, mask=mask)
        # into the world that the graph of a step returns, by a graph too
        if mask is None:
            mask = torch.ones(self.n_lanes, dtype=torch.bool, device=self.device)
        arguments = (mask,) if seeds is None else (mask, seeds)
        if len(arguments) not in self._resets:

            def masked(mask, seeds=None) -> World:
                return self._reset(seed=seeds, mask=mask)

            self._resets[len(arguments)] = capture(masked, arguments, self.roots)
        return self._resets[len(arguments)](*arguments)

    def _seeds(self, seed) -> torch.Tensor | None:
        if seed is None:
            return None
        if isinstance(seed, (int, np.integer)):
            return int(seed) + torch.arange(self.n_lanes, device=self.device)
        seeds = [*seed] if isinstance(seed, Iterable) else [seed]
        if len(seeds) != self.n_lanes or not all(isinstance(s, (int, np.integer)) for s in seeds):
            raise ValueError(
                f"seed must be an integer, or {self.n_lanes} of them, one per lane, not {seed!r}"
            )
        return torch.as_tensor(seeds, dtype=torch.int64).to(self.device)

    def _mask(self, values) -> torch.Tensor | None:
        if values is None:
            return None
        mask = torch.as_tensor(values)
        if mask.shape != (self.n_lanes,) or mask.dtype != torch.bool:
            raise ValueError(
                f"a reset's mask must be bool, of shape ({self.n_lanes},), not {mask.dtype} of "
                f"shape {tuple(mask.shape)}"
            )
        return mask.to(self.device)

    def _decision(self, actions) -> arrdict:
        """Returns the decision of actions (B, ...): discrete ones of any integer type or bool."""

        def converted(space, values) -> torch.Tensor:
            is_discrete = isinstance(space, spaces.MultiDiscrete)
            dtype = torch.int64 if is_discrete else torch.float32
            may_follow = self._source.type == "cuda"  # the CPU reads what is there
            values = torch.as_tensor(values)
            if is_discrete and not torch.can_cast(values.dtype, dtype):
                text = f"actions must be integers from 0 to {space.n_actions - 1}, but their dtype"
                raise ValueError(f"{text} is {values.dtype}; convert them to int64")
            values = values.to(self._source, dtype, non_blocking=may_follow)
            shape = self.n_lanes, *space.shape
            if values.numel() != math.prod(shape):
                raise ValueError(f"actions must fit {shape}, but their shape is {(*values.shape,)}")
            return values.reshape(shape).contiguous()

        return arrdict(actions=spaces.map(converted, self.env.action_space, actions))

    def step(self, actions: Tree) -> tuple[World, World, torch.Tensor]:
        """Returns (world, final world, where an episode ended). With ``same_step``, the first has
        the first observation where an episode ended, and the final world its last one; otherwise
        both are the same. On a GPU the same objects each time.
        """
        self._require_own()
        if not isinstance(self._step, Graph):
            with torch.inference_mode(False), torch.no_grad():
                decision = self._decision(actions)
                if self._step is None and self._on_gpu:
                    self._step = capture(self._recorded, (decision,), self.roots)
                if not isinstance(self._step, Graph):
                    return (self._step or self._advance)(decision)
        if self.copies:
            self.copies.prepare()
        with torch.no_grad():  # the graph reads the decision, so inference mode may stay
            return self._step.with_leaves(leaves(self._decision(actions)))

    def _recorded(self, decision) -> tuple[World, World, torch.Tensor]:
        there = decision.map(lambda leaf: leaf.to(self.device, non_blocking=True))
        stepped = self._advance(there)
        if self._parts:
            parts = mapping(torch.Tensor.contiguous)(self._parts(*stepped))
            on_gpu = all(x.is_cuda for x in leaves(parts))
            if on_gpu and sum(x.nbytes for x in leaves(parts)) < MAX_BYTES:
                self.copies = Copies(parts, self._row, self._to_numpy)
                if not torch.cuda.is_current_stream_capturing():
                    self.copies.prepare(1)
                self.copies.write()
        return stepped

    def _next_step(self, decision) -> tuple[World, World, torch.Tensor]:
        world = self.env.step(decision)
        return world, world, ended(world)

    def _same_step(self, decision) -> tuple[World, World, torch.Tensor]:
        world, _, over = self._next_step(decision)
        if not self._on_gpu and not over.any():
            return world, world, over
        tensors, spec = tree_flatten(world)
        final = tree_unflatten(copies(tensors), spec)
        return self._reset(mask=over), final, over

    def close(self) -> None:
        """Closes the environment."""
        optional(self.env, "close")()
