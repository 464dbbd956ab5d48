"""An update of a learner as a CUDA graph."""

from collections.abc import Callable
from typing import Any

import torch

from megastep.agents.generator import SeededGenerator

# updates done eagerly, and for real, before one is captured: libraries set themselves up in the
# first
_WARM_UPS = 2


class CudaGraphUpdate:
    """`update(rollout)`, a function that returns a dict of tensors and never synchronises, on a GPU
    as a CUDA graph; elsewhere, and where not `graph`, as it is.

    The first updates are eager, on the stream that captures. A graph belongs to the rollout that it
    was captured with: another one is captured anew, so a learner is given one and the same.

    Args: `device`, the policy's, whichever GPU is current; `randoms`, the random streams that the
    update draws from.
    """

    def __init__(
        self,
        update: Callable[[Any], dict[str, torch.Tensor]],
        device: torch.device,
        graph: bool,
        randoms: tuple[SeededGenerator, ...] = (),
    ):
        self.update, self.device, self.randoms = update, device, randoms
        self.stream = torch.cuda.Stream(device) if graph and device.type == "cuda" else None
        self.restart()

    def restart(self) -> None:
        """Warms up and captures anew: the random streams are others now."""
        self.graph = self._rollout = self._metrics = None
        self._warm_ups = _WARM_UPS

    def __call__(self, rollout: Any) -> dict[str, torch.Tensor]:
        """One update. Returns what the function does, in memory that the next leaves alone."""
        if self.stream is None:
            return self.update(rollout)
        with torch.cuda.device(self.device):
            if self._warm_ups:
                self._warm_ups -= 1
                return self._warm_up(rollout)
            if self._rollout is not rollout:
                self._capture(rollout)
            self.graph.replay()
            return {key: value.clone() for key, value in self._metrics.items()}

    def _warm_up(self, rollout):
        # PyTorch would warn that gradients were first added up on another stream, which this waits
        # for
        torch.autograd.graph.set_warn_on_accumulate_grad_stream_mismatch(False)
        self.stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self.stream):
            metrics = self.update(rollout)
        torch.cuda.current_stream().wait_stream(self.stream)
        return metrics

    def _capture(self, rollout):
        graph = torch.cuda.CUDAGraph()
        for random in self.randoms:
            graph.register_generator_state(random.on(self.device))
        try:
            with torch.cuda.graph(graph, stream=self.stream):
                self._metrics = self.update(rollout)
        except RuntimeError as error:
            # the end of a capture that failed fails as well: the first error is the one to tell
            raise error.__context__ or error from None
        self.graph, self._rollout = graph, rollout
