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


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("shape", [(1, 1), (7, 133), (32, 1000)])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.8, 1.0])
def test_moments_are_those_of_the_valid_entries(device, shape, share):
    torch.manual_seed(0)
    tensors = [torch.randn(shape) * 3 + 1000, torch.randn(shape)]
    valid = torch.rand(shape) < share
    expected = [x[valid].double() for x in tensors]
    tensors = [x.masked_fill(~valid, torch.nan).to(device) for x in tensors]
    results = [masked_stats.pooled_moments(tensors, valid.to(device)) for _ in range(2)]
    assert all(map(torch.equal, *results))
    n_valid, means, variances = results[0]
    assert n_valid == valid.sum() and n_valid.dtype == torch.int64
    for i, x in enumerate(expected):
        mean = x.mean() if len(x) else 0.0
        # float32 near 1,000
        assert means[i].item() == pytest.approx(float(mean), rel=1e-6, abs=1e-6)
        variance = (x - mean).square().mean() if len(x) else 0.0
        assert variances[i].item() == pytest.approx(float(variance), rel=1e-4, abs=1e-6)
    if len(expected[0]):
        tensors[0][valid] = torch.nan
        _, means, _ = masked_stats.pooled_moments(tensors, valid.to(device))
        assert means[0].isnan() and means[1].isfinite()
