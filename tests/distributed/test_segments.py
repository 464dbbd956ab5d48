"""Functions recorded as several CUDA graphs."""

import pytest
import torch

from megastep.agents.distributed import segments


class Noise:
    """Adds random numbers to a total, and between them doubles it outside of the graphs."""

    def __init__(self, n_splits, is_recorded):
        self.n_splits, self.total = n_splits, torch.zeros(4, device="cuda")
        self.generator = torch.Generator("cuda").manual_seed(1)
        self.add()  # libraries initialise themselves
        self.graph = None
        if is_recorded:
            stream = torch.cuda.Stream()
            self.graph = segments.SegmentedGraph(self.add, stream, [self.generator])

    def add(self):
        for _ in range(self.n_splits):
            self.total += self._random()
            seen = self.total * 2
            segments.between_graphs(lambda seen=seen: self.total.copy_(seen))
        return self.total + self._random()

    def _random(self):
        return torch.rand(4, generator=self.generator, device="cuda")

    def __call__(self):
        if self.graph is None:
            return self.add()
        self.graph.replay()
        return self.graph.output.clone()


@pytest.mark.cuda
@pytest.mark.parametrize("n_splits", [0, 1, 3])
def test_replays_have_the_bits_of_calls(n_splits):
    called, recorded = Noise(n_splits, False), Noise(n_splits, True)
    assert len(recorded.graph.parts) == 1 + 2 * n_splits
    for _ in range(3):
        assert torch.equal(called(), recorded())
        assert torch.equal(called.total, recorded.total)


@pytest.mark.cuda
def test_an_error_while_recording_is_the_first_one():
    def fails():
        segments.between_graphs(lambda: None)
        torch.zeros(1, device="cuda").item()  # synchronises

    with pytest.raises(RuntimeError, match="captur"):
        segments.SegmentedGraph(fails, torch.cuda.Stream())
    calls = []
    segments.between_graphs(lambda: calls.append(1))
    assert calls == [1]  # nothing is being recorded any more
    torch.rand(1, device="cuda")  # the default generator is usable again
