"""A function recorded as several CUDA graphs, with calls between them.

A CUDA graph that holds a collective operation of NCCL can wait forever: graphs of different
processes may start in different orders on a GPU's queues. So collectives are called between graphs.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable
from typing import Any

import torch

from megastep.capture import end_failed_recording

#: The graph that is being recorded.
_recording: SegmentedGraph | None = None


def between_graphs(call: Callable[[], object]) -> None:
    """Calls a function; while a `SegmentedGraph` records, has each replay call it in this place.

    Args:
        call: changes tensors in place. Is not called while a graph is recorded.
    """
    if _recording is None:
        call()
    else:
        _recording.split(call)


class SegmentedGraph:
    """Records a function as CUDA graphs: as one, unless the function calls `between_graphs`.

    All graphs share one pool of memory, so a tensor of one segment can be read in the next.

    Args:
        function: never synchronises. Its tensors keep their place in memory.
        stream: the stream to record on.
        generators: the generators that the function draws from.

    Attributes:
        output: what the function returned; each replay writes its tensors again.
    """

    def __init__(
        self,
        function: Callable[[], Any],
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
                self._begin()
                try:
                    self.output = function()
                finally:  # ending a failed recording raises as well
                    self._end()
        except RuntimeError as error:
            end_failed_recording()
            raise error.__context__ or error from None  # the first error is the informative one
        finally:
            _recording = None

    def _begin(self) -> None:
        self.graph = torch.cuda.CUDAGraph()
        for generator in self.generators:
            self.graph.register_generator_state(generator)
        # threads of NCCL may query events meanwhile
        self.graph.capture_begin(self.pool, capture_error_mode="thread_local")

    def _end(self) -> None:
        self.graph.capture_end()
        self.parts.append(self.graph.replay)

    def split(self, call: Callable[[], object]) -> None:
        """Ends a graph, adds a call and begins another graph."""
        self._end()
        self.parts.append(call)
        self._begin()

    def replay(self) -> None:
        """Runs the function again."""
        for part in self.parts:
            part()
