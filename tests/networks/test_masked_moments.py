"""Moments of the valid ones of many numbers, and normalisation by them."""

import pytest
import torch

from megastep.agents.networks.running_norm import masked_moments, normalise_masked


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
