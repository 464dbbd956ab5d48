"""Parallel linear recurrences against the recursion step by step."""

import pytest
import torch

from megastep.agents.networks.scan import linear_scan

F64_CLOSE = dict(rtol=1e-10, atol=1e-10)  # two orders of summing a few float64 numbers


def by_steps(terms, factors, reset):
    sums, last = [], torch.zeros_like(terms[0])
    for term, factor, is_reset in zip(terms, factors, reset, strict=True):
        last = torch.where(is_reset, term, term + factor * last)
        sums.append(last)
    return torch.stack(sums)


@pytest.mark.parametrize("T", [1, 2, 3, 8, 13, 32])
def test_matches_recursion_in_both_directions(T):
    torch.manual_seed(T)
    terms, factors = torch.randn(2, T, 5, 3, dtype=torch.float64)
    reset = torch.rand(T, 5, 1) < 0.2
    expected = by_steps(terms, factors, reset)
    torch.testing.assert_close(linear_scan(terms, factors, reset), expected, **F64_CLOSE)
    backwards = by_steps(terms.flip(0), factors.flip(0), reset.flip(0)).flip(0)
    torch.testing.assert_close(
        linear_scan(terms, factors, reset, reverse=True), backwards, **F64_CLOSE
    )
    unbroken = by_steps(terms, factors, torch.zeros(T, 1, 1, dtype=torch.bool))
    torch.testing.assert_close(linear_scan(terms, factors), unbroken, **F64_CLOSE)


def test_reset_restarts_sum():
    ones = torch.ones(6, 1)
    reset = torch.tensor([0, 0, 0, 1, 0, 0], dtype=torch.bool)[:, None]
    assert linear_scan(ones, ones)[:, 0].tolist() == [1, 2, 3, 4, 5, 6]
    assert linear_scan(ones, ones, reset)[:, 0].tolist() == [1, 2, 3, 1, 2, 3]
    assert linear_scan(ones, ones, reset, reverse=True)[:, 0].tolist() == [4, 3, 2, 1, 2, 1]


@pytest.mark.parametrize("garbage", [torch.nan, torch.inf, 1e30])
def test_values_before_reset_change_no_bit_after_it(garbage):
    terms, factors = torch.randn(2, 13, 4)
    reset = torch.zeros(13, 1, dtype=torch.bool)
    reset[5] = True
    clean = linear_scan(terms, factors, reset)
    terms[:5], factors[:6] = garbage, garbage
    assert torch.equal(linear_scan(terms, factors, reset)[5:], clean[5:])
