"""Statistics over valid entries, against hand calculations."""

import math

import pytest
import torch

from megastep.agents.algorithms import masked_stats
from megastep.agents.networks.running_norm import masked_moments, normalise_masked


def test_mean_and_normalise_use_valid_only():
    x = torch.tensor([[1.0, 5.0], [torch.nan, 3.0]])
    valid = ~x.isnan()
    assert masked_stats.masked_mean(x, valid).item() == 3
    std = math.sqrt(8 / 3)
    expected = torch.tensor([[-2 / std, 2 / std], [0.0, 0.0]])
    torch.testing.assert_close(masked_stats.pooled_normalise(x, valid), expected)
    assert masked_stats.masked_mean(x, torch.zeros_like(valid)).item() == 0


def test_explained_variance():
    targets, valid = torch.tensor([[1.0, 2.0, 6.0]]), torch.tensor([[True, True, True]])
    assert masked_stats.explained_variance(targets + 4, targets, valid).item() == pytest.approx(1)
    assert masked_stats.explained_variance(
        torch.zeros(1, 3), targets, valid
    ).item() == pytest.approx(0)
    assert masked_stats.explained_variance(-targets, targets, valid).item() == pytest.approx(-3)
    constant = torch.ones(1, 3)  # such as where nothing is rewarded yet
    assert masked_stats.explained_variance(constant, constant, valid).item() == 1


def test_effective_sample_size():
    weights = torch.tensor([[2.0, 2.0, torch.nan], [2.0, 2.0, 0.0]])
    valid = ~weights.isnan()
    assert masked_stats.effective_sample_size(weights, valid).item() == pytest.approx(64 / (5 * 16))
    alone = torch.tensor([0.0, 3.0, 0.0, 0.0])
    assert masked_stats.effective_sample_size(alone, alone >= 0).item() == pytest.approx(1 / 4)
    assert masked_stats.effective_sample_size(alone, alone > 5).item() == 0


def test_mean_along_axis():
    x, valid = torch.tensor([[1.0, 5.0], [3.0, torch.nan]]), torch.tensor([[True, False]] * 2)
    assert masked_stats.masked_mean(x, valid, 0).tolist() == [2, 0]


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("shape", [(1,), (3, 5), (2048,), (32, 1000), (7, 70_001)])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.8, 1.0])
def test_moments_and_normalised_numbers_are_those_of_the_valid_entries(device, shape, share):
    """Far from 0, where the square of the mean would swallow the variance."""
    torch.manual_seed(0)
    valid = torch.rand(shape) < share
    arrays = [torch.randn(shape) * 3 + 1000, torch.randn(shape), torch.rand(shape)]
    expected = [x[valid].double() for x in arrays]
    valid = valid.to(device)
    arrays = [x.to(device).masked_fill(~valid, torch.nan) for x in arrays]
    results = masked_moments(valid, *arrays)
    for x, entries, moments in zip(arrays, expected, results, strict=True):
        n_valid, mean, variance = moments
        assert n_valid == len(entries) and n_valid.dtype == torch.int64
        normalised = normalise_masked(x, valid, moments)
        assert not normalised[~valid].any()
        if not len(entries):
            assert mean == variance == 0
            continue
        assert mean.item() == pytest.approx(entries.mean().item(), rel=1e-6, abs=1e-6)
        spread = entries.std(correction=0)
        assert variance.item() == pytest.approx(spread.square().item(), rel=1e-4, abs=1e-6)
        if len(entries) > 1:
            # float32 near 1,000
            close = dict(rtol=1e-3, atol=1e-3)
            exact = (entries - entries.mean()) / spread
            torch.testing.assert_close(normalised[valid].cpu().double(), exact, **close)


def test_a_gpu_takes_no_valid_numbers_more_arrays_and_other_layouts(to_gpu):
    x, nothing = to_gpu(torch.randn(4, 6)), to_gpu(torch.zeros(4, 6, dtype=bool))
    for n, mean, variance in masked_moments(nothing, x, x):
        assert (n, mean, variance) == (0, 0, 0)
    assert not normalise_masked(x, nothing, masked_moments(nothing, x)[0]).any()
    of_many = masked_moments(~nothing, *[x] * 5)
    of_transposed = masked_moments(~nothing.T, x.T)
    for one in (*of_many, *of_transposed):
        torch.testing.assert_close(one[1], x.mean())
        torch.testing.assert_close(one[2], x.var(correction=0))
