"""A learner's update as a CUDA graph."""

from collections.abc import Callable

import torch

from megastep.agents.distributed import process_group
from megastep.agents.generator import SeededGenerator
from megastep.agents.types import RolloutLike
from megastep.capture import end_failed_recording, recording

# Updates that run eagerly before the capture, since libraries initialise themselves in the first.
# They train the policy like any other update.
_N_WARM_UPS = 2

Metrics = dict[str, torch.Tensor]


class CudaGraphUpdate:
    """Calls an update function, on a GPU through a CUDA graph, with the sums over the ranks in it.

    The first updates run eagerly. A graph reads the memory of the rollout it was captured with, so
    another rollout object causes another capture: pass the same object every time.

    Args:
        update: a function of a rollout that returns tensors () by name, if any, and never
            synchronises.
        device: device of the policy; need not be the current GPU.
        graph: whether to capture. A CPU always runs eagerly.
        generators: the generators that `update` draws from.
    """

    def __init__(
        self,
        update: Callable[..., Metrics],
        device: torch.device,
        graph: bool,
        generators: tuple[SeededGenerator, ...] = (),
    ):
        self.update, self.device, self.generators = update, device, generators
        self.stream = torch.cuda.Stream(device) if graph and device.type == "cuda" else None
        self.restart()

    def restart(self) -> None:
        """Discards the graph. The next updates warm up and capture again."""
        self.graph: torch.cuda.CUDAGraph | None = None
        self._rollout, self._names, self._output = None, [], torch.empty(0)
        self._n_warm_ups_left = _N_WARM_UPS

    def __call__(self, rollout: RolloutLike) -> Metrics:
        """Performs one update. The tensors it returns are not overwritten by the next one."""
        if self.stream is None:
            return self.update(rollout)
        if self.graph is None or self._rollout is not rollout:
            with torch.cuda.device(self.device):
                if self._n_warm_ups_left:
                    self._n_warm_ups_left -= 1
                    return self._warm_up(rollout)
                self.graph, self._rollout = self._recorded(rollout), rollout
        with torch.cuda.device(self.device):
            self.graph.replay()
        return dict(zip(self._names, self._output.clone().unbind())) if self._names else {}

    def _recorded(self, rollout) -> torch.cuda.CUDAGraph:
        assert self.stream is not None
        graph = torch.cuda.CUDAGraph()
        for generator in self.generators:
            graph.register_generator_state(generator.on(self.device))
        try:
            with recording(graph, self.stream):
                metrics = self.update(rollout)
                self._names = [*metrics]
                if metrics:  # in one tensor, of which a single kernel makes a copy
                    self._output = torch.stack([*metrics.values()]).detach()
        except RuntimeError as error:
            end_failed_recording()
            raise error.__context__ or error from None  # the first error is the informative one
        process_group.graphs.add(graph)
        return graph

    def _warm_up(self, rollout) -> Metrics:
        # PyTorch would warn of gradients accumulated on another stream, which this one waits for
        torch.autograd.graph.set_warn_on_accumulate_grad_stream_mismatch(False)
        assert self.stream is not None
        self.stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self.stream):
            metrics = self.update(rollout)
        torch.cuda.current_stream().wait_stream(self.stream)
        return metrics
