"""The sum tree, against NumPy's cumulative sums."""

import numpy as np
import pytest
import torch
from torch import testing

from megastep.agents.storage.sum_tree import SumTree
from megastep.capture import Graph


def filled(values, device="cpu", **how):
    tree = SumTree(len(values), device, **how)
    tree.set(torch.arange(len(values), device=device), torch.as_tensor(values, device=device))
    return tree


def oracle(priorities, n, seed):
    """Indices by a search in the cumulative sum of all priorities, from the same random numbers."""
    generator = torch.Generator().manual_seed(seed)
    share = torch.rand(n, generator=generator, dtype=torch.float64).numpy()
    sums = np.cumsum(priorities.astype(np.float64))
    return np.searchsorted(sums, (np.arange(n) + share) / n * sums[-1], side="right")


@pytest.mark.parametrize("n, fan_out", [(1, 2), (2, 2), (5, 2), (16, 16), (17, 16), (3000, 32)])
def test_samples_are_those_of_a_search_in_the_cumulative_sum(n, fan_out):
    priorities = np.random.default_rng(n).exponential(size=n) ** 3
    tree = filled(priorities, fan_out=fan_out)
    drawn = tree.sample(257, torch.Generator().manual_seed(5)).numpy()
    assert np.array_equal(drawn, oracle(priorities, 257, 5))
    testing.assert_close(tree.total.item(), priorities.sum(), rtol=1e-12, atol=0)
    chance = tree.probability(torch.from_numpy(drawn)).numpy()
    np.testing.assert_allclose(chance, (priorities / priorities.sum())[drawn], rtol=1e-12)


def test_indices_are_drawn_as_often_as_their_priorities_say(device):
    priorities = np.array([0.0, 1, 2, 3, 0, 4, 30, 0] * 9)
    tree = filled(priorities, device, fan_out=4)
    # of one part each, so that draws are independent
    generator = torch.Generator(device).manual_seed(1)
    drawn = torch.cat([tree.sample(1, generator) for _ in range(4000)])
    counts = np.bincount(drawn.cpu().numpy(), minlength=len(priorities))
    expected = 4000 * priorities / priorities.sum()
    some = priorities > 0
    assert counts[~some].sum() == 0
    # chi-square of 44 degrees of freedom is above 87 in one of ten thousand seeds
    assert ((counts - expected)[some] ** 2 / expected[some]).sum() < 87


def test_each_part_of_the_total_is_drawn_from_once():
    drawn = filled(np.ones(64)).sample(64, torch.Generator().manual_seed(3))
    assert drawn.tolist() == list(range(64))


@pytest.mark.parametrize("where", ["first", "last", "one in ten"])
def test_a_priority_of_zero_is_never_drawn(where):
    n = 1000
    priorities = np.random.default_rng(2).random(n) * 1e-3 + 1e3
    chosen = {"first": np.arange(n) < 990, "last": np.arange(n) >= 10}.get(
        where, np.arange(n) % 10 != 7
    )
    priorities[chosen] = 0
    tree = filled(priorities)
    drawn = tree.sample(20_000, torch.Generator().manual_seed(4)).numpy()
    assert not chosen[drawn].any()
    assert set(drawn) == set(np.flatnonzero(~chosen))


def test_what_is_drawn_at_the_very_edge_of_two_priorities(monkeypatch):
    """Random numbers of exactly 0 lead to the sums themselves."""
    monkeypatch.setattr(torch, "rand", lambda n, **how: torch.zeros(n, dtype=torch.float64))
    assert filled(np.array([0.0, 1, 0, 2, 1])).sample(4).tolist() == [1, 3, 3, 4]


def test_without_a_positive_priority_the_first_is_drawn_with_probability_zero():
    tree = SumTree(100)
    drawn = tree.sample(8)
    assert drawn.tolist() == [0] * 8 and tree.probability(drawn).tolist() == [0.0] * 8


def test_of_an_index_that_occurs_several_times_the_largest_value_stands(device):
    tree = filled(np.full(70, 9.0), device)
    index = torch.tensor([3, 69, 3, 3, 69], device=device)
    tree.set(index, torch.tensor([1.0, 5.0, 4.0, 2.0, 0.0], device=device))
    expected = torch.full((70,), 9.0, dtype=torch.float64)
    expected[3], expected[69] = 4.0, 5.0
    assert torch.equal(tree.priorities.cpu(), expected)
    assert tree.total.item() == expected.sum().item()


@pytest.mark.parametrize("n", [1, 40, 5000])
def test_sums_do_not_drift_however_often_priorities_change(n):
    """The numbers span nine powers of ten: what remains of a large one, taken away by a difference,
    would drown the small.
    """
    generator = torch.Generator().manual_seed(0)
    tree = SumTree(n)
    for _ in range(200):
        index = torch.randint(n, (50,), generator=generator)
        tree.set(index, 10 ** (9 * torch.rand(50, generator=generator)))
    tree.set(torch.arange(n), torch.full((n,), 1e-3))
    testing.assert_close(tree.total.item(), n * 1e-3, rtol=1e-6, atol=0)  # of a float32 .001
    for lower, upper in zip(tree.levels, tree.levels[1:]):
        assert torch.equal(upper.view(-1)[: len(lower)], lower.sum(-1))


def test_a_million_priorities():
    n = 1_000_003
    priorities = np.random.default_rng(1).random(n)
    tree = filled(priorities)
    assert len(tree.levels) == 4
    assert tree.bytes < 1.05 * 8 * n
    drawn = tree.sample(4096, torch.Generator().manual_seed(7)).numpy()
    # sums are added up in another order, so that a neighbour may be meant
    assert np.abs(drawn - oracle(priorities, 4096, 7)).max() <= 1


@pytest.mark.parametrize("n, fan_out", [(0, 32), (5, 1)])
def test_a_tree_needs_priorities_and_children(n, fan_out):
    with pytest.raises(ValueError, match="two children per node"):
        SumTree(n, fan_out=fan_out)


@pytest.mark.cuda
def test_a_captured_tree_is_the_eager_one():
    values = torch.rand(5000, device="cuda")
    found = []
    for is_captured in (False, True):
        tree = filled(values.cpu().numpy(), "cuda")
        generator = torch.Generator("cuda").manual_seed(1)
        out = torch.zeros(4, 64, dtype=torch.int64, device="cuda")

        def work(tree=tree, generator=generator, out=out):
            for row in out:
                row.copy_(tree.sample(64, generator))
                tree.set(row, tree.probability(row) * 100)

        if is_captured:
            work = Graph(work, (), (tree, generator, out))
        for _ in range(3):
            work()
        found.append((out.cpu(), tree.priorities.cpu()))
    for eager, captured in zip(*found):
        assert torch.equal(eager, captured)


@pytest.mark.cuda
def test_a_tree_never_synchronises():
    tree, index = SumTree(5000, "cuda"), torch.arange(100, device="cuda")
    values, generator = torch.rand(100, device="cuda"), torch.Generator("cuda").manual_seed(1)
    torch.cuda.set_sync_debug_mode("error")
    try:
        tree.set(index, values)
        tree.probability(tree.sample(64, generator))
    finally:
        torch.cuda.set_sync_debug_mode("default")
