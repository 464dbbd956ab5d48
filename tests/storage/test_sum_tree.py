"""The sum tree against searches in NumPy's cumulative sums."""

import numpy as np
import pytest
import torch
from torch import testing

from megastep.agents.storage.sum_tree import SumTree


def filled(values, device="cpu"):
    """Returns a tree with these priorities."""
    tree = SumTree(len(values), device)
    tree.set(torch.arange(len(values), device=device), torch.as_tensor(values, device=device))
    return tree


def oracle(priorities, n, seed):
    """Draws indices by a search in the cumulative sum, with the same random numbers."""
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(n, generator=generator, dtype=torch.float64).numpy()
    sums = np.cumsum(priorities.astype(np.float64))
    return np.searchsorted(sums, (np.arange(n) + share) / n * sums[-1], side="right")


@pytest.mark.parametrize("n", [1, 32, 33, 3000])
def test_sample_matches_search_in_cumulative_sum(n):
    priorities = np.random.default_rng(n).exponential(size=n) ** 3
    tree = filled(priorities)
    drawn, chance = (x.numpy() for x in tree.draw(257, torch.Generator().manual_seed(5)))
    assert np.array_equal(drawn, oracle(priorities, 257, 5))
    testing.assert_close(tree.total.item(), priorities.sum(), rtol=1e-12, atol=0)
    np.testing.assert_allclose(chance, (priorities / priorities.sum())[drawn], rtol=1e-12)


def test_sample_frequencies_match_priorities(device):
    priorities = np.array([0.0, 1, 2, 3, 0, 4, 30, 0] * 9)
    tree = filled(priorities, device)
    # one sample per call, so that samples are independent
    generator = torch.Generator(device).manual_seed(1)
    drawn = torch.cat([tree.draw(1, generator)[0] for _ in range(4000)])
    counts = np.bincount(drawn.cpu().numpy(), minlength=len(priorities))
    expected = 4000 * priorities / priorities.sum()
    positive = priorities > 0
    assert counts[~positive].sum() == 0
    # chi-square of 44 degrees of freedom is above 87 in one of ten thousand seeds
    assert ((counts - expected)[positive] ** 2 / expected[positive]).sum() < 87


def test_sampling_is_stratified():
    drawn = filled(np.ones(64)).draw(64, torch.Generator().manual_seed(3))[0]
    assert drawn.tolist() == list(range(64))


@pytest.mark.parametrize("where", ["first", "last", "one in ten"])
def test_zero_priorities_are_never_drawn(where):
    n = 1000
    priorities = np.random.default_rng(2).random(n) * 1e-3 + 1e3
    index = np.arange(n)
    is_zero = {"first": index < 990, "last": index >= 10, "one in ten": index % 10 != 7}[where]
    priorities[is_zero] = 0
    tree = filled(priorities)
    drawn = tree.draw(20_000, torch.Generator().manual_seed(4))[0].numpy()
    assert not is_zero[drawn].any()
    assert set(drawn) == set(np.flatnonzero(~is_zero))


def test_all_zero_priorities_draw_index_zero():
    tree = SumTree(100)
    drawn, probability = tree.draw(8)
    assert drawn.tolist() == [0] * 8 and probability.tolist() == [0.0] * 8


def test_set_keeps_largest_value_of_repeated_index(device):
    tree = filled(np.full(70, 9.0), device)
    index = torch.tensor([3, 69, 3, 3, 69], device=device)
    tree.set(index, torch.tensor([1.0, 5.0, 4.0, 2.0, 0.0], device=device))
    expected = torch.full((70,), 9.0, dtype=torch.float64)
    expected[3], expected[69] = 4.0, 5.0
    assert torch.equal(tree.priorities.cpu(), expected)
    assert tree.total.item() == expected.sum().item()


@pytest.mark.parametrize("n", [1, 40, 5000])
def test_sums_do_not_drift(n):
    """Priorities span nine powers of ten: updates by differences would leave errors larger than the
    small priorities.
    """
    generator = torch.Generator().manual_seed(0)
    tree = SumTree(n)
    for _ in range(200):
        index = torch.randint(n, (50,), generator=generator)
        tree.set(index, 10 ** (9 * torch.rand(50, generator=generator)))
    tree.set(torch.arange(n), torch.full((n,), 1e-3))
    testing.assert_close(tree.total.item(), n * 1e-3, rtol=1e-6, atol=0)  # .001 as float32
    for lower, upper in zip(tree.levels, tree.levels[1:]):
        assert torch.equal(upper.view(-1)[: len(lower)], lower.sum(-1))


@pytest.mark.parametrize("n", [1, 40, 70_000])
def test_kernels_match_pytorch(n, to_gpu):
    values = 10 ** (9 * torch.rand(n, generator=torch.Generator().manual_seed(0)).double())
    values[1::3] = 0
    plain, fused = SumTree(n), SumTree(n)
    fused.levels = [to_gpu(level) for level in fused.levels]
    device = fused.levels[0].device
    index = torch.randint(n, (900,), generator=torch.Generator().manual_seed(1))
    for tree, to in (plain, torch.Tensor.cpu), (fused, to_gpu):
        tree.set(to(torch.arange(n)), to(values))
        tree.set(to(index), to(values.flip(0)[index // 2]))
    for ours, theirs in zip(fused.levels, plain.levels, strict=True):
        testing.assert_close(ours.cpu(), theirs, rtol=1e-12, atol=0)
    drawn, probability = fused.draw(2000, torch.Generator(device).manual_seed(2))
    expected = plain.priorities[drawn.cpu()] / plain.total
    testing.assert_close(probability.cpu(), expected, rtol=1e-12, atol=0)
    generator = torch.Generator(device).manual_seed(2)
    share = torch.rand(2000, generator=generator, dtype=torch.float64, device=device)
    sums = plain.priorities.cumsum(0)
    rest = (share.cpu() + torch.arange(2000)) / 2000 * sums[-1]
    expected = torch.searchsorted(sums, rest, right=True)
    # sums in another order may select a neighbour
    assert (drawn.cpu() != expected).float().mean() < 0.01
    assert (plain.priorities[drawn.cpu()] > 0).all()
