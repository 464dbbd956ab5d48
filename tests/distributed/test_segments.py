"""Functions recorded as several CUDA graphs."""

import pytest
import torch

from megastep.agents.distributed import segments


def noisy_sums(total, generator, n_splits):
    """Adds random numbers to a total, and between them doubles it outside of the graphs."""
    for _ in range(n_splits):
        total += torch.rand(4, generator=generator, device=total.device)
        seen = total * 2
        segments.between_graphs(lambda seen=seen: total.copy_(seen))
    return (total + torch.rand(4, generator=generator, device=total.device)).clone()


def test_without_a_recording_it_is_called_at_once():
    calls = []
    segments.between_graphs(lambda: calls.append(1))
    assert calls == [1]


@pytest.mark.cuda
@pytest.mark.parametrize("n_splits", [0, 1, 3])
def test_replays_have_the_bits_of_calls(n_splits):
    results = []
    for is_recorded in (False, True):
        total = torch.zeros(4, device="cuda")
        generator = torch.Generator("cuda").manual_seed(1)
        first = noisy_sums(total, generator, n_splits)  # libraries initialise themselves
        if is_recorded:
            graph = segments.SegmentedGraph(
                lambda: noisy_sums(total, generator, n_splits), torch.cuda.Stream(), [generator]
            )
            assert len(graph.parts) == 1 + 2 * n_splits

            def call():
                graph.replay()
                return graph.output.clone()

        else:

            def call():
                return noisy_sums(total, generator, n_splits)

        results.append(torch.stack([first, call(), call(), total]))
    assert torch.equal(*results)


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
