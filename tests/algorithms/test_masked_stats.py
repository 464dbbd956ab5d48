"""Statistics over the valid, by hand."""

import math

import pytest
import torch

from megastep.agents.algorithms import masked_stats


def test_means_and_standard_deviations_are_over_the_valid():
    x, valid = (
        torch.tensor([[1.0, 5.0], [torch.nan, 3.0]]),
        torch.tensor([[True, True], [False, True]]),
    )
    assert masked_stats.masked_mean(x, valid).item() == 3
    std = math.sqrt(8 / 3)
    expected = torch.tensor([[-2 / std, 2 / std], [0.0, 0.0]])
    torch.testing.assert_close(masked_stats.normalised(x, valid), expected)
    assert masked_stats.masked_mean(x, torch.zeros_like(valid)).item() == 0


def test_explained_variance_of_the_truth_is_one_and_of_a_constant_zero():
    targets, valid = torch.tensor([[1.0, 2.0, 6.0]]), torch.tensor([[True, True, True]])
    assert masked_stats.explained_variance(targets + 4, targets, valid).item() == pytest.approx(1)
    assert masked_stats.explained_variance(
        torch.zeros(1, 3), targets, valid
    ).item() == pytest.approx(0)
    assert masked_stats.explained_variance(-targets, targets, valid).item() == pytest.approx(-3)


def test_the_effective_sample_size_by_hand():
    weights = torch.tensor([[2.0, 2.0, torch.nan], [2.0, 2.0, 0.0]])
    valid = ~weights.isnan()
    assert masked_stats.effective_sample_size(weights, valid).item() == pytest.approx(64 / (5 * 16))
    alone = torch.tensor([0.0, 3.0, 0.0, 0.0])
    assert masked_stats.effective_sample_size(alone, alone >= 0).item() == pytest.approx(1 / 4)
    assert masked_stats.effective_sample_size(alone, alone > 5).item() == 0


def test_means_along_an_axis():
    x, valid = torch.tensor([[1.0, 5.0], [3.0, torch.nan]]), torch.tensor([[True, False]] * 2)
    assert masked_stats.masked_mean(x, valid, 0).tolist() == [2, 0]
