"""Any environment's step as a CUDA graph, and the walk over all that can change in it.

Whatever changes in an environment is a tensor or a generator reachable from its attributes.
:func:`state_tree` finds them, for capture, checkpoints and resume alike; :func:`capture` records a
function of such state once and replays it without Python.
"""

import ast
import contextlib
import traceback
import types
import warnings

import torch
from torch.utils import _pytree

SCALARS = (bool, int, float, str, type(None))
OPAQUE = (
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
        return [
            (f".{key}", child)
            for group in ("_parameters", "_buffers", "_modules")
            for key, child in getattr(node, group).items()
        ] + [(f".{key}", child) for key, child in vars(node).items() if not key.startswith("_")]
    return (
        [(f".{key}", child) for key, child in vars(node).items()]
        if hasattr(node, "__dict__")
        else []
    )


def _walk(root, wanted):
    """{path: (parent, step, leaf)} of the leaves of types ``wanted`` below ``root``, each object
    once.
    """
    found, seen, stack = {}, set(), [("", None, "", root)]
    while stack:
        path, parent, step, node = stack.pop()
        if isinstance(node, wanted):
            found[path] = (parent, step, node)
        elif (
            not isinstance(node, (*OPAQUE, *SCALARS, torch.Tensor, torch.Generator))
            and id(node) not in seen
        ):
            seen.add(id(node))
            stack += [
                (path + below, node, below, child) for below, child in reversed(_children(node))
            ]
    return found


def state_tree(env):
    """{path: tensor or generator} of everything in ``env`` that can change; paths read as
    attributes do, ``.core.agents.positions``.
    """
    return {
        path: leaf for path, (_, _, leaf) in _walk(env, (torch.Tensor, torch.Generator)).items()
    }


def snapshot(env):
    """A copy of what :func:`state_tree` finds, for :func:`restore`."""
    return {
        path: leaf.detach().clone() if isinstance(leaf, torch.Tensor) else leaf.get_state()
        for path, leaf in state_tree(env).items()
    }


@torch.no_grad()
def restore(env, saved):
    """Writes a :func:`snapshot` back, in place. ValueError, naming the first, if the tree has other
    leaves now.
    """
    tree = state_tree(env)
    missing = sorted(saved.keys() - tree.keys())
    if missing:
        raise ValueError(
            f"the state holds {missing[0][1:]}, which this {type(env).__name__} does not have: it "
            f"belongs to "
            f"another environment or version"
        )
    for path, value in saved.items():
        leaf = tree[path]
        if isinstance(leaf, torch.Generator):
            leaf.set_state(value)
        elif leaf.shape != value.shape or leaf.dtype != value.dtype:
            raise ValueError(
                f"the state's {path[1:]} is {tuple(value.shape)} {value.dtype}, but this "
                f"{type(env).__name__} "
                f"needs {tuple(leaf.shape)} {leaf.dtype}"
            )
        else:
            leaf.copy_(value)


def _rebind(parent, step, leaf):
    if isinstance(parent, tuple):
        raise TypeError("a tensor inside a tuple was replaced")
    if step.startswith("["):
        parent.__setitem__(ast.literal_eval(step[1:-1]), leaf)
    elif isinstance(parent, torch.nn.Module) and step[1:] in parent._parameters:
        parent._parameters[step[1:]] = leaf
    else:
        setattr(parent, step[1:], leaf)


def _renew_generators(roots):
    """Replaces the generators on GPUs: a capture that failed leaves its own believing that it goes
    on.
    """
    renewed = {}
    for parent, step, old in _walk(roots, torch.Generator).values():
        if old.device.type == "cuda":
            with contextlib.suppress(TypeError, AttributeError):
                _rebind(parent, step, renewed.setdefault(id(old), torch.Generator(old.device)))


class CaptureError(RuntimeError):
    """A function cannot be replayed as a graph. The message is one sentence with the cure."""


class _State:
    """The state of some objects before and after a call: what a graph has to keep in place."""

    def __init__(self, roots):
        self.roots = dict(enumerate(roots))
        self.tensors, self.scalars = _walk(self.roots, torch.Tensor), _walk(self.roots, SCALARS)

    def settle(self):
        """Copies tensors that were rebound back to where they were, and refuses scalars that
        changed.
        """
        scalars = _walk(self.roots, SCALARS)
        for path in scalars.keys() & self.scalars.keys():
            old, new = self.scalars[path][2], scalars[path][2]
            if old != new and not (old != old and new != new):
                raise CaptureError(
                    f"{_readable(path)} changed from {old!r} to {new!r} during the call, but a "
                    f"graph replays "
                    f"tensors only: make it a tensor on the device."
                )
        for path, (parent, step, new) in _walk(self.roots, torch.Tensor).items():
            old = self.tensors.get(path, (None, None, None))[2]
            if old is None or new is old:
                continue
            if old.shape != new.shape or old.dtype != new.dtype:
                raise CaptureError(
                    f"{_readable(path)} changed its shape or dtype during the call, from "
                    f"{tuple(old.shape)} "
                    f"{old.dtype} to {tuple(new.shape)} {new.dtype}: keep them fixed."
                )
            try:
                old.copy_(new)
                _rebind(parent, step, old)
            except (TypeError, AttributeError) as error:
                raise CaptureError(
                    f"{_readable(path)} was replaced where it cannot be put back ({error}): "
                    f"change it in place."
                ) from None

    def undo(self):
        """Puts back every tensor and scalar that is another now than it was, as far as it can be
        put anywhere.
        """
        for before in (self.tensors, self.scalars):
            now = _walk(self.roots, (torch.Tensor, *SCALARS))
            for path, (parent, step, leaf) in before.items():
                if path not in now or now[path][2] is not leaf:
                    with contextlib.suppress(TypeError, AttributeError, KeyError, IndexError):
                        _rebind(parent, step, leaf)


def _readable(path):
    return path.partition("]")[2].lstrip(".")


class Graph:
    """A captured function. Calling it copies the arguments' tensors in, replays, and returns the
    outputs, which are valid until the next call.
    """

    def __init__(self, function, args, roots, warmup=3):
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
            self._record(function, inputs, roots, warmup)

    def _record(self, function, inputs, roots, warmup):
        saved, original = snapshot(roots), _State(roots.values())
        generators = [
            leaf
            for leaf in state_tree(roots).values()
            if isinstance(leaf, torch.Generator) and leaf.device.type == "cuda"
        ]
        self._graph = torch.cuda.CUDAGraph()
        for generator in generators:
            self._graph.register_generator_state(generator)
        try:
            side = torch.cuda.Stream()
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):
                for _ in range(warmup):
                    state = _State(roots.values())
                    function(*inputs)
                    state.settle()
            torch.cuda.current_stream().wait_stream(side)
            restore(roots, saved)
            state = _State(roots.values())
            with torch.cuda.graph(self._graph, stream=side):
                self._out = function(*inputs)
                state.settle()
        except RuntimeError:
            _renew_generators(roots)
            raise
        finally:
            original.undo()
            restore(roots, saved)

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
                        f"{tuple(inside.shape)}, but was "
                        f"called with {tuple(given.shape)}"
                    )
                inside.copy_(given)
        with torch.cuda.device(self._device):
            self._graph.replay()
        return self._out


def capture(function, args, roots, warmup=3):
    """``function`` recorded as a CUDA graph on the device of its state, or ``function`` itself,
    with one warning that names the line, if it cannot be.

    Args: ``args`` a tuple of example arguments, trees of tensors of fixed shapes; ``roots`` the
    objects whose tensors and generators the function changes. Their state is as before afterwards:
    warming up does not advance the world.
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
    """Where outside PyTorch and this file a error was raised, to follow a sentence."""
    if isinstance(error, CaptureError):
        return ""
    frames = traceback.extract_tb(error.__traceback__)
    frames = [f for f in frames if "/torch/" not in f.filename and f.filename != __file__]
    return f" at {frames[-1].filename}:{frames[-1].lineno}" if frames else ""


class Captured:
    """An environment whose ``step`` is replayed as a CUDA graph, recorded at the first step; on the
    CPU the environment as it is. Everything else is the environment's own.
    """

    def __init__(self, env):
        self.env, self._step = env, None

    def __getattr__(self, name):
        return getattr(self.env, name)

    def step(self, decision):
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
