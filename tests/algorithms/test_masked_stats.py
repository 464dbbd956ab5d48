"""Statistics over valid entries, against hand calculations."""

import math

import pytest
import torch

from megastep.agents.algorithms import masked_stats


def test_mean_and_normalise_use_valid_only():
    x, valid = (
        torch.tensor([[1.0, 5.0], [torch.nan, 3.0]]),
        torch.tensor([[True, True], [False, True]]),
    )
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
