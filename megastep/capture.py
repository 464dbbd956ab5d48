"""CUDA graphs of an environment's step, or of any function of tensors.

:func:`capture` records a function once; calls replay it without Python. Everything that the
function changes must be a tensor or a generator reachable from the attributes of its ``roots`` (see
:mod:`megastep.engine.state_tree`). Their values are restored after the recording, so warming up
does not advance an environment. :class:`Captured` captures the ``step`` of an environment.
"""

import collections
import contextlib
import gc
import re
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, cast

import torch
from torch.utils import _pytree

from megastep.engine.state_tree import SCALARS, node_at, rebind, restore, snapshot, state_tree, walk
from megastep.env_state import GENERATORS, LARGE, EnvState, as_bytes, name_of
from megastep.types import Env, World, optional

__all__ = ["CaptureError", "Captured", "Graph", "capture", "restore", "snapshot", "state_tree"]


class CaptureError(RuntimeError):
    """A function cannot be replayed as a CUDA graph. The message names the cure."""


class _StateBefore:
    """The tensors, Python scalars and contents of containers below objects, before a call."""

    def __init__(self, roots) -> None:
        self.roots = dict(enumerate(roots))
        self.leaves = self._walk()
        self.containers = [
            (node, dict(node) if isinstance(node, dict) else [*node])
            for _, _, node in walk(self.roots, (list, collections.deque, dict)).values()
        ]

    def _walk(self) -> dict[str, tuple]:
        return walk(self.roots, (torch.Tensor, *SCALARS))

    def keep_in_place(self, output=None) -> object:
        """Copies each tensor that replaced another into the old one, and puts the old one back.
        Called after the function. Returns its output, with copies of what is overwritten.

        A tensor that replaced None, or a new attribute, stays: the function writes there from now
        on. Raises CaptureError for any other change that a graph cannot repeat.
        """
        now, replaced = self._walk(), []
        reachable = {id(leaf) for _, _, leaf in now.values()}
        for path, (_, _, old) in self.leaves.items():
            name = path.partition("]")[2].lstrip(".")  # without the number of its root
            parent, step, new = now.get(path, (None, "", None))
            is_tensor = isinstance(new, torch.Tensor)
            if isinstance(old, torch.Tensor):
                if is_tensor and new is not old:
                    replaced.append((name, parent, step, old, new))
                elif not is_tensor and id(old) not in reachable:
                    raise CaptureError(
                        f"{name}, a tensor of shape {tuple(old.shape)}, was removed during the "
                        "call: keep it, and change it in place."
                    )
                continue
            is_same = old is None if is_tensor else old == new or (old != old and new != new)
            if path in now and not is_same:
                raise CaptureError(
                    f"{name} changed from {old!r} to {'a tensor' if is_tensor else repr(new)} "
                    "during the call, but a CUDA graph replays tensors only: make it a tensor on "
                    "the device."
                )
        overwritten = {_storage(old) for *_, old, _ in replaced}

        def kept(leaf) -> object:
            is_tensor = overwritten and isinstance(leaf, torch.Tensor)
            return leaf.clone() if is_tensor and _storage(leaf) in overwritten else leaf

        # all are read before the first is written, as in `self.last, self.now = self.now, new`
        output = _pytree.tree_map(kept, output)
        replaced = [(*place, old, kept(new)) for *place, old, new in replaced]
        for name, parent, step, old, new in replaced:
            _copy_back(name, parent, step, old, new)
        return output

    def undo(self) -> None:
        """Puts back what was replaced, wherever assignment works."""
        for node, members in self.containers:
            with contextlib.suppress(TypeError, AttributeError):
                node.clear()
                (node.update if isinstance(node, dict) else node.extend)(members)
        now = self._walk()
        for path, (parent, step, leaf) in self.leaves.items():
            if path not in now or now[path][2] is not leaf:
                with contextlib.suppress(TypeError, AttributeError, KeyError, IndexError):
                    rebind(parent, step, leaf)


def _storage(tensor) -> tuple[torch.device, int]:
    """Returns what is equal for tensors that share memory."""
    with torch._C.DisableTorchFunctionSubclass():  # a ReadOnlyTensor would copy it
        return tensor.device, tensor.untyped_storage().data_ptr()


def _copy_back(name, parent, step, old, new) -> None:
    if old.shape != new.shape or old.dtype != new.dtype:
        raise CaptureError(
            f"{name} changed its shape or dtype during the call, from {tuple(old.shape)} "
            f"{old.dtype} to {tuple(new.shape)} {new.dtype}: keep both fixed."
        )
    try:
        old.copy_(new)
        rebind(parent, step, old)
    except (TypeError, AttributeError) as error:
        raise CaptureError(
            f"{name} was replaced and cannot be put back ({error}): change it in place."
        ) from None


def _renew_generators(roots) -> None:
    """Replaces GPUs' generators, which a failed recording leaves marked as being captured."""
    renewed = {}
    for parent, step, old in walk(roots, (torch.Generator,)).values():
        if old.device.type == "cuda":
            with contextlib.suppress(TypeError, AttributeError):
                rebind(parent, step, renewed.setdefault(id(old), torch.Generator(old.device)))


@contextlib.contextmanager
def recording(graph: torch.cuda.CUDAGraph, stream: torch.cuda.Stream) -> Iterator[None]:
    """``torch.cuda.graph`` without garbage collection: freeing another graph ends a recording.

    Other threads, such as NCCL's, may query events meanwhile.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        with torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
            yield
    finally:
        if was_enabled:
            gc.enable()


def end_failed_recording() -> None:
    """Makes PyTorch's default generator of the current GPU usable again after a recording failed,
    which leaves it marked as being captured, so that drawing from it raises. The next recording
    that succeeds removes the mark; this makes one, if the GPU still works.
    """
    graph, stream = torch.cuda.CUDAGraph(), torch.cuda.Stream()
    with contextlib.suppress(RuntimeError):  # the error of the failed recording is the one to raise
        with recording(graph, stream):
            torch.zeros((), device="cuda")  # PyTorch warns about empty graphs


class Graph:
    """A function recorded as a CUDA graph. Arguments are those of :func:`capture`.

    A call copies the tensors of its arguments in, on the CPU into page-locked memory, replays it,
    and returns the outputs, valid until the next call. The tensors of ``roots`` live as long as it.
    It may still read arguments on the CPU when it returns: wait for it before the next call.
    """

    IS_STATELESS = True  # its tensors are copies, see :func:`megastep.engine.state_tree.walk`

    def __init__(
        self,
        function: Callable,
        args: tuple,
        roots: tuple,
        warmup: int = 3,
        changed: Callable[[], str | None] = lambda: None,
    ):
        leaves, self._spec = _pytree.tree_flatten(args)
        numbered = dict(enumerate(roots))
        tensors = [x for x in (*leaves, *state_tree(numbered).values()) if torch.is_tensor(x)]
        self._device = next((x.device for x in tensors if x.device.type == "cuda"), None)
        leaves = [leaf.clone() if torch.is_tensor(leaf) else leaf for leaf in leaves]
        if self._device:  # which reads page-locked memory itself
            leaves = [x if getattr(x, "is_cuda", True) else x.pin_memory() for x in leaves]
        self._leaves, inputs = leaves, _pytree.tree_unflatten(leaves, self._spec)
        with torch.cuda.device(self._device):
            saved, original = snapshot(numbered), _StateBefore(roots)
            try:
                self._record(function, inputs, numbered, saved, warmup)
                if name := changed():
                    raise CaptureError(
                        f"{name} changed during the call, but a CUDA graph replays tensors only: "
                        f"make it a tensor or a torch.Generator on the device."
                    )
            except BaseException as error:
                original.undo()
                if isinstance(error, Exception):
                    end_failed_recording()
                    _renew_generators(numbered)
                raise
            finally:
                restore(numbered, saved)
        # not the objects: those that hold their graph would be freed late, by garbage collection
        leaves = walk(numbered, torch.Tensor, only_state=False).values()
        self._tensors = [leaf for _, _, leaf in leaves]

    def _record(self, function, inputs, roots, saved, warmup) -> None:
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
        with recording(self._graph, side):
            self._out = before.keep_in_place(function(*inputs))

    def __call__(self, *args) -> Any:
        leaves, spec = _pytree.tree_flatten(args)
        if spec != self._spec:
            raise ValueError(
                f"the function was captured with arguments {self._spec}, but called with {spec}"
            )
        return self.with_leaves(leaves)

    def with_leaves(self, leaves: Sequence) -> Any:
        """Calls it with the leaves of its arguments, whose trees take longer than all else."""
        for buffer, leaf in zip(self._leaves, leaves):
            if isinstance(buffer, torch.Tensor):
                if buffer.shape != leaf.shape:
                    raise ValueError(
                        f"the function was captured with an argument of shape "
                        f"{tuple(buffer.shape)}, but called with {tuple(leaf.shape)}"
                    )
                buffer.copy_(leaf)
        with torch.cuda.device(self._device):
            self._graph.replay()
        return self._out


def capture(
    function: Callable,
    args: tuple,
    roots: tuple,
    warmup: int = 3,
    changed: Callable[[], str | None] = lambda: None,
) -> Callable:
    """Records a function as a CUDA graph on the device of its state. Returns the :class:`Graph`, or
    ``function`` itself with one warning that names the line, if it cannot be captured.

    A tensor that the function creates where an attribute was None is kept with the value of the
    last warm-up call, because the graph writes into it.

    Args:
        function: takes ``args``. Changes only tensors and generators below ``roots``.
        args: example arguments, trees of tensors whose shapes stay fixed.
        roots: objects whose state the function changes. Their values are restored afterwards.
        warmup: number of calls before the recording.
        changed: called after the recording, returns the name of what else has changed, if anything.
    """
    try:
        return Graph(function, args, roots, warmup, changed)
    except Exception as error:  # libraries of others raise their own; bugs are raised eagerly again
        # the first error; ending a failed capture raises another
        while isinstance(error, RuntimeError) and not error.__suppress_context__:
            if not isinstance(error.__context__, Exception):
                break
            error = error.__context__
        text = str(error).partition("\n")[0]
        if not (text and isinstance(error, RuntimeError)):
            text = f"{type(error).__name__} {text}".rstrip()
        warnings.warn(f"running without a CUDA graph, slower: {text}{_line(error)}", stacklevel=2)
        return function


def _line(error) -> str:
    if isinstance(error, CaptureError):
        return ""
    frames = traceback.extract_tb(error.__traceback__)
    frames = [f for f in frames if "/torch/" not in f.filename and f.filename != __file__]
    return f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""


class HostState(EnvState):
    """The state of an environment that is not in tensors, and that in tensors and generators on the
    CPU where the environment is on a GPU, before a CUDA graph is recorded; also of the policies
    that act in it.
    """

    knows_large = False

    def __init__(self, env: Env, policies: object = None):
        super().__init__(env, policies)
        self.is_on_gpu = torch.device(env.device).type == "cuda"
        self.before = self._records()
        for path, (kind, *parts) in self.before.items():
            if kind == "tensor":  # what else changes is a copy
                self.before[path] = "tensor", parts[0].clone() if self._is_frozen(path) else None

    def changed(self) -> str | None:
        """Returns the name of something that has changed: a plain value, an array, the length of a
        list, a generator, or a tensor on the CPU. None if there is none, or all objects are
        megastep's own.
        """
        if not any(is_users for *_, is_users in self._nodes()):
            return None
        was, now = self._comparable(self.before), self._comparable(self._records())
        changed = sorted(path for path in {*was, *now} if was.get(path) != now.get(path))
        if not changed:
            return None
        is_global = re.match(r"\.generators\['(\w+)'\]", changed[0])
        return f"the global generator of {is_global[1]}" if is_global else name_of(changed[0])

    def restore(self) -> None:
        """Puts all back, but for the lengths of lists and tensors."""
        now = self._records()
        for path, record in self.before.items():
            has_changed = record[0] == "value" and repr(now.get(path)) != repr(record)
            if has_changed or record[0] in ("array", "generator"):
                self._load({path: record})

    def _comparable(self, records) -> dict[str, list]:
        """Returns {name: what is equal for equal values} of what no graph repeats."""
        comparable = {}
        for path, (kind, *parts) in records.items():
            name = f"{path} (its length)" if kind == "list" else path
            if kind in ("value", "array", "list") or self._is_frozen(path):
                parts = parts[:1] if kind == "tensor" else parts
                comparable[name] = [
                    as_bytes(part).numpy().tobytes()
                    if isinstance(part, torch.Tensor)
                    else repr(part)
                    for part in parts
                ]
        return comparable

    def _is_frozen(self, path) -> bool:
        """Returns whether a graph repeats nothing there: another device, another's generator."""
        node = node_at(self.root, path)
        if isinstance(node, (torch.Tensor, torch.Generator)):
            is_small = isinstance(node, torch.Generator) or node.nbytes < LARGE
            return self.is_on_gpu and node.device == torch.device("cpu") and is_small
        return isinstance(node, GENERATORS)


class Captured:
    """Wraps an environment on a GPU so that ``step`` replays a CUDA graph, recorded at the first
    step. On the CPU, and if the environment is not ``capturable``, ``step`` is its own. All other
    attributes are the environment's.
    """

    capturable = False  # a graph cannot be replayed in another one's recording

    def __init__(self, env: Env):
        self.env, self._step = env, None

    def __getattr__(self, name: str) -> Any:
        if name == "env":  # not set yet while the object is being copied
            raise AttributeError(name)
        return getattr(self.env, name)

    def __getstate__(self) -> dict[str, object]:
        return {"env": self.env, "_step": None}  # a copy records a graph of its own

    def step(self, decision: Mapping) -> World:
        """Steps the environment by ``decision["actions"]``; other keys are dropped. On a GPU the
        returned world is valid until the next step.
        """
        decision = cast("type[dict]", type(decision))(actions=decision["actions"])
        if self._step is None:
            on_gpu = torch.device(self.env.device).type == "cuda"
            self._step = (
                capture(self.env.step, (decision,), (self.env,))
                if on_gpu and optional(self.env, "capturable")
                else self.env.step
            )
        return self._step(decision)
