"""Moments of the valid ones of many numbers, and normalisation by them."""

import pytest
import torch

from megastep.agents.networks.masked_moments import masked_moments, normalise_masked


def test_only_valid_numbers_count():
    x, valid = torch.tensor([1.0, torch.nan, 5.0]), torch.tensor([True, False, True])
    (of_x, of_double) = masked_moments(valid, x, 2 * x)
    assert [number.item() for number in of_x] == [2, 3, 4]
    assert [number.item() for number in of_double] == [2, 6, 16]
    assert normalise_masked(x, valid, of_x).tolist() == pytest.approx([-1, 0, 1])
    ((n, mean, variance),) = masked_moments(torch.zeros_like(valid), x)
    assert (n, mean, variance) == (0, 0, 0)


@pytest.mark.cuda
@pytest.mark.parametrize("shape", [(1,), (3, 5), (2048,), (32, 4096), (7, 70_001)])
def test_a_gpu_finds_the_same_moments(shape):
    """Far from 0, where the square of the mean would swallow the variance."""
    torch.manual_seed(0)
    valid = torch.rand(shape) < 0.7
    arrays = [torch.randn(shape) * 3 + 1000, torch.randn(shape), torch.rand(shape)]
    for x in arrays:
        x[~valid] = torch.nan
    plain = masked_moments(valid, *(x.double() for x in arrays))
    fused = masked_moments(valid.cuda(), *(x.cuda() for x in arrays))
    for x, one, other in zip(arrays, fused, plain, strict=True):
        assert one[0].item() == other[0].item()
        for number, expected in zip(one[1:], other[1:], strict=True):
            torch.testing.assert_close(number.cpu().double(), expected, rtol=1e-4, atol=1e-5)
        result = normalise_masked(x.cuda(), valid.cuda(), one).cpu()
        expected = normalise_masked(x.double(), valid, other)
        # the mean of numbers near 1000 has an error of 1e-4
        torch.testing.assert_close(result.double(), expected, rtol=1e-3, atol=1e-3)


@pytest.mark.cuda
def test_a_gpu_takes_no_valid_numbers_more_arrays_and_other_layouts():
    x, nothing = torch.randn(4, 6, device="cuda"), torch.zeros(4, 6, dtype=bool, device="cuda")
    for n, mean, variance in masked_moments(nothing, x, x):
        assert (n, mean, variance) == (0, 0, 0)
    assert not normalise_masked(x, nothing, masked_moments(nothing, x)[0]).any()
    of_many = masked_moments(~nothing, *[x] * 5)
    of_transposed = masked_moments(~nothing.T, x.T)
    for one in (*of_many, *of_transposed):
        torch.testing.assert_close(one[1], x.mean())
        torch.testing.assert_close(one[2], x.var(correction=0))
