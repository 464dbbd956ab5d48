"""CUDA graphs of PyTorch operations on a CPU: recorded as they are dispatched, and replayed.

What is not an operation of PyTorch, Python included, happens once, in the recording, as on a GPU.
"""

import contextlib

import torch
from torch.utils import _python_dispatch, _pytree

from megastep import capture


class _Recorder(_python_dispatch.TorchDispatchMode):
    may_wait = False

    def __init__(self, operations):
        super().__init__()
        self.operations = operations

    def __torch_dispatch__(self, operation, types, args=(), options=None):
        is_waiting = operation is torch.ops.aten._local_scalar_dense.default
        if is_waiting and not self.may_wait:
            raise RuntimeError("the host waits for the device during a recording")
        result = operation(*args, **(options or {}))
        self.operations.append((operation, args, options or {}, result))
        return result


class GraphOnCpu:
    """Stands in for `torch.cuda.CUDAGraph`."""

    is_recording = False
    recorded: list = []  # of the graph that is being recorded

    def __init__(self):
        self.operations = []

    def register_generator_state(self, generator):
        """Nothing: generators of a CPU draw on in every replay."""

    @torch.no_grad()
    def replay(self):
        if GraphOnCpu.is_recording:
            raise RuntimeError("a graph is replayed during a recording")
        for operation, args, options, result in self.operations:
            addresses = {_address(leaf) for leaf in _tensors((args, options))}
            again = operation(*args, **options)
            for old, new in zip(_tensors(result), _tensors(again), strict=True):
                if _address(old) not in addresses:  # no view, and nothing changed in place
                    old.copy_(new)


def _tensors(tree):
    return [leaf for leaf in _pytree.tree_leaves(tree) if isinstance(leaf, torch.Tensor)]


def _address(tensor):
    return tensor.untyped_storage().data_ptr()


@contextlib.contextmanager
def _record(graph, stream=None, capture_error_mode="global"):
    GraphOnCpu.is_recording, GraphOnCpu.recorded = True, graph.operations
    try:
        with _Recorder(graph.operations):
            yield
    finally:
        GraphOnCpu.is_recording, GraphOnCpu.recorded = False, []


class _Stream:
    def __init__(self, device=None):
        """It has no state."""

    def wait_stream(self, other):
        """Nothing: operations on a CPU run one after the other."""

    def synchronize(self):
        """Nothing, for the same reason."""


def install(monkeypatch, may_wait=False):
    """Has `megastep.capture` record graphs on a CPU.

    Args:
        may_wait: whether the host may wait for the device in a recording, as some code does on a
            CPU only.
    """
    monkeypatch.setattr(_Recorder, "may_wait", may_wait)
    for name, stand_in in dict(
        CUDAGraph=GraphOnCpu,
        Stream=_Stream,
        current_stream=_Stream,
        stream=contextlib.nullcontext,
        device=contextlib.nullcontext,
        graph=_record,
        is_current_stream_capturing=lambda: GraphOnCpu.is_recording,
    ).items():
        monkeypatch.setattr(torch.cuda, name, stand_in)
    monkeypatch.setattr(capture, "end_failed_recording", lambda: None)
