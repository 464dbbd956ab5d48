"""Any environment's step, or any function of tensors, as a CUDA graph.

:func:`capture` records a function once and replays it without Python. What the function changes
must be tensors and generators reachable from the objects it is given as roots (see
:mod:`~megastep.state`); their values are put back after the recording, so that warming up does not
advance an environment. :class:`Captured` does this to an environment's ``step``.
"""

import contextlib
import traceback
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch.utils import _pytree

from megastep.engine.state_tree import SCALARS, rebind, restore, snapshot, state_tree, walk

__all__ = ["CaptureError", "Captured", "Graph", "capture", "restore", "snapshot", "state_tree"]


class CaptureError(RuntimeError):
    """A function cannot be replayed as a graph. The message is one sentence with the cure."""


class _StateBefore:
    """Which tensors and scalars some objects held before a call of a function."""

    def __init__(self, roots):
        self.roots = dict(enumerate(roots))
        self.tensors, self.scalars = walk(self.roots, torch.Tensor), walk(self.roots, SCALARS)

    def keep_in_place(self):
        """After the call: copies tensors that were rebound to where they were before, and raises
        CaptureError for any other change that a graph cannot repeat. A tensor that appears where
        None stood, or nothing, stays: it is where the function will write from now on.
        """
        tensors, scalars = walk(self.roots, torch.Tensor), walk(self.roots, SCALARS)
        self._refuse_changed_scalars(tensors, scalars)
        reachable = {id(leaf) for _, _, leaf in tensors.values()}
        for path, (_, _, old) in self.tensors.items():
            if path not in tensors:
                if id(old) in reachable:
                    continue
                raise CaptureError(
                    f"{_readable(path)} was a tensor of shape {tuple(old.shape)} before the call "
                    f"and is gone after it: keep it, and change it in place."
                )
            parent, step, new = tensors[path]
            if new is not old:
                _copy_back(path, parent, step, old, new)

    def _refuse_changed_scalars(self, tensors, scalars):
        for path, (_, _, old) in self.scalars.items():
            new = scalars[path][2] if path in scalars else old
            tensor = path in tensors and old is not None
            if tensor or (old != new and not (old != old and new != new)):
                became = "a tensor" if tensor else repr(new)
                raise CaptureError(
                    f"{_readable(path)} changed from {old!r} to {became} during the call, but a "
                    f"graph replays tensors only: make it a tensor on the device."
                )

    def undo(self):
        """Puts back every tensor and scalar that is another now than it was, as far as it can be
        put anywhere.
        """
        for before in (self.tensors, self.scalars):
            now = walk(self.roots, (torch.Tensor, *SCALARS))
            for path, (parent, step, leaf) in before.items():
                if path not in now or now[path][2] is not leaf:
                    with contextlib.suppress(TypeError, AttributeError, KeyError, IndexError):
                        rebind(parent, step, leaf)


def _copy_back(path, parent, step, old, new):
    if old.shape != new.shape or old.dtype != new.dtype:
        raise CaptureError(
            f"{_readable(path)} changed its shape or dtype during the call, from "
            f"{tuple(old.shape)} {old.dtype} to {tuple(new.shape)} {new.dtype}: keep them fixed."
        )
    try:
        old.copy_(new)
        rebind(parent, step, old)
    except (TypeError, AttributeError) as error:
        raise CaptureError(
            f"{_readable(path)} was replaced where it cannot be put back ({error}): change it in "
            f"place."
        ) from None


def _readable(path):
    """A path without the number of its root."""
    return path.partition("]")[2].lstrip(".")


def _renew_generators(roots):
    """Replaces the generators on GPUs: those that a failed recording registered stay in the state
    of being captured.
    """
    renewed = {}
    for parent, step, old in walk(roots, (torch.Generator,)).values():
        if old.device.type == "cuda":
            with contextlib.suppress(TypeError, AttributeError):
                rebind(parent, step, renewed.setdefault(id(old), torch.Generator(old.device)))


class Graph:
    """A captured function. Calling it copies the arguments' tensors in, replays, and returns the
    outputs, which are valid until the next call. Arguments are as for :func:`capture`.
    """

    def __init__(self, function: Callable, args: tuple, roots: tuple, warmup: int = 3):
        leaves, self._spec = _pytree.tree_flatten(args)
        self._leaves = [leaf.clone() if isinstance(leaf, torch.Tensor) else leaf for leaf in leaves]
        inputs = _pytree.tree_unflatten(self._leaves, self._spec)
        roots = dict(enumerate(roots))
        tensors = [
            leaf
            for leaf in [*leaves, *state_tree(roots).values()]
            if isinstance(leaf, torch.Tensor)
        ]
        self._device = next((leaf.device for leaf in tensors if leaf.device.type == "cuda"), None)
        with torch.cuda.device(self._device):
            saved, original = snapshot(roots), _StateBefore(roots.values())
            try:
                self._record(function, inputs, roots, saved, warmup)
            except BaseException as error:
                if isinstance(error, RuntimeError):
                    _renew_generators(roots)
                original.undo()
                raise
            finally:
                restore(roots, saved)

    def _record(self, function, inputs, roots, saved, warmup):
        self._graph = torch.cuda.CUDAGraph()
        for leaf in state_tree(roots).values():
            if isinstance(leaf, torch.Generator) and leaf.device.type == "cuda":
                self._graph.register_generator_state(leaf)
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(warmup):
                before = _StateBefore(roots.values())
                function(*inputs)
                before.keep_in_place()
        torch.cuda.current_stream().wait_stream(side)
        restore(roots, saved)
        before = _StateBefore(roots.values())
        with torch.cuda.graph(self._graph, stream=side):
            self._out = function(*inputs)
            before.keep_in_place()

    def __call__(self, *args):
        leaves, spec = _pytree.tree_flatten(args)
        if spec != self._spec:
            raise ValueError(
                f"the captured function was recorded with arguments {self._spec}, but was called "
                f"with {spec}"
            )
        for inside, given in zip(self._leaves, leaves):
            if isinstance(inside, torch.Tensor):
                if inside.shape != given.shape:
                    raise ValueError(
                        f"the captured function was recorded with an argument of shape "
                        f"{tuple(inside.shape)}, but was called with {tuple(given.shape)}"
                    )
                inside.copy_(given)
        with torch.cuda.device(self._device):
            self._graph.replay()
        return self._out


def capture(function: Callable, args: tuple, roots: tuple, warmup: int = 3) -> Callable:
    """``function`` recorded as a CUDA graph on the device of its state, or ``function`` itself,
    with one warning that names the line, if it cannot be.

    Args: ``args`` a tuple of example arguments, trees of tensors of fixed shapes; ``roots`` the
    objects whose tensors and generators the function changes. Their values are as before
    afterwards. A tensor that appears where None stood is kept, with the value that the last of
    ``warmup`` calls gave it, because the graph writes into it: what must begin with another value
    is made before capturing.
    """
    try:
        return Graph(function, args, roots, warmup)
    except RuntimeError as error:
        while isinstance(
            error.__context__, RuntimeError
        ):  # the end of a failed capture fails once more
            error = error.__context__
        warnings.warn(
            f"running without a CUDA graph, slower: {str(error).splitlines()[0]}{_line(error)}",
            stacklevel=2,
        )
        return function


def _line(error):
    """Where outside PyTorch and this file an error was raised, to follow a sentence."""
    if isinstance(error, CaptureError):
        return ""
    frames = traceback.extract_tb(error.__traceback__)
    frames = [f for f in frames if "/torch/" not in f.filename and f.filename != __file__]
    return f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""


class Captured:
    """An environment whose ``step`` is replayed as a CUDA graph, recorded at the first step; on the
    CPU the environment as it is. Everything else is the environment's own.
    """

    def __init__(self, env: Any):
        self.env, self._step = env, None

    def __getattr__(self, name):
        return getattr(self.env, name)

    def step(self, decision: dict) -> dict:
        """As the environment's; on a GPU the world returned is valid until the next step. Only
        ``decision.actions`` reaches it.
        """
        decision = type(decision)(actions=decision["actions"])
        if self._step is None:
            on_gpu = torch.device(self.env.device).type == "cuda"
            self._step = (
                capture(self.env.step, (decision,), (self.env,)) if on_gpu else self.env.step
            )
        return self._step(decision)
