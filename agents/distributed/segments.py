"""Records a function as several CUDA graphs, with collective operations between them.

NCCL collectives inside CUDA graphs can deadlock, since graphs of different processes may start in
different orders on a GPU's queues.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable

import torch

from megastep.capture import end_failed_recording

#: The graph being recorded, if any.
_recording: SegmentedGraph | None = None


def between_graphs(call: Callable[[], object]) -> None:
    """Calls a function; while a `SegmentedGraph` records, has each replay call it at this point.

    Args:
        call: changes tensors in place. Not called during the recording.
    """
    if _recording is None:
        call()
        return
    _recording.end()
    _recording.parts.append(call)
    _recording.begin()


class SegmentedGraph:
    """Records a function as CUDA graphs: one, and one more after each call of `between_graphs`.

    All graphs share a memory pool, so a tensor of one segment can be read in the next.

    Args:
        function: must not synchronise. Its tensors must keep their addresses.
        generators: random generators that the function uses.

    Attributes:
        output: the function's result; each replay overwrites its tensors.
    """

    def __init__(
        self,
        function: Callable,
        stream: torch.cuda.Stream,
        generators: Iterable[torch.Generator] = (),
    ):
        global _recording
        self.pool, self.generators = torch.cuda.graph_pool_handle(), tuple(generators)
        self.parts: list[Callable[[], object]] = []
        torch.cuda.synchronize()
        gc.collect()
        torch.cuda.empty_cache()
        _recording = self
        try:
            with torch.cuda.stream(stream):
                self.begin()
                try:
                    self.output = function()
                finally:  # raises a second error if the function failed
                    self.end()
        except RuntimeError as error:
            end_failed_recording()
            raise error.__context__ or error from None  # the first error is the informative one
        finally:
            _recording = None

    def begin(self) -> None:
        self.graph = torch.cuda.CUDAGraph()
        for generator in self.generators:
            self.graph.register_generator_state(generator)
        # thread_local, since NCCL's threads may query events meanwhile
        self.graph.capture_begin(self.pool, capture_error_mode="thread_local")

    def end(self) -> None:
        self.graph.capture_end()
        self.parts.append(self.graph.replay)

    def replay(self) -> None:
        """Runs the recorded graphs and the calls between them."""
        for part in self.parts:
            part()
