"""Running statistics of observations. test_heads.py tests that they are per channel or number."""

import math

import pytest
import torch

from megastep import spaces
from megastep.agents.networks.running_norm import RunningNorm, add_moments, moments_of
from tests.helpers.weights import moved


def update(norm, *observations):
    obs, *is_counted = observations
    add_moments([norm], moments_of([norm], [obs], *is_counted))


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e30])
def test_nonfinite_observations_change_nothing(bad):
    norm = RunningNorm(spaces.MultiVector(1, 2))
    update(norm, torch.randn(64, 1, 2) + 5)
    before = {name: tensor.clone() for name, tensor in norm.state_dict().items()}
    # 1e30 is finite, its square is not
    update(norm, torch.tensor([1.0, 2.0, 3.0, bad]).view(2, 1, 2))
    update(norm, torch.zeros(2, 1, 2), torch.tensor(False))
    moments = moments_of([norm], [torch.zeros(2, 1, 2)])
    add_moments([norm], moments, torch.tensor(False))
    assert all(torch.equal(norm.state_dict()[name], before[name]) for name in before)


def test_masked_lanes_do_not_count():
    image = spaces.MultiImage(2, 3, 1, 5, dtype=torch.uint8)
    norm, fewer = RunningNorm(image), RunningNorm(image)
    obs, is_counted = torch.randint(256, (40, 2, 3, 1, 5), dtype=torch.uint8), torch.rand(40) < 0.5
    update(norm, obs, is_counted)
    update(fewer, obs[is_counted])
    torch.testing.assert_close(norm.mean, fewer.mean)
    torch.testing.assert_close(norm.scale, fewer.scale)
    expected = obs[is_counted].double().std((0, 3, 4), correction=0).float()
    torch.testing.assert_close(norm.scale.flatten(), expected.flatten())
    before = norm.mean.clone()
    update(norm, obs, torch.zeros(40, dtype=torch.bool))
    assert torch.equal(norm.mean, before) and norm.count == 1


def test_gpu_adds_the_same_moments_as_the_cpu(to_gpu):
    """Images, vectors, a NaN in a lane that does not count, and another in a leaf of its own."""
    check_gpu(to_gpu, torch.float16)


def test_gpu_adds_the_same_moments_of_bytes_and_doubles(to_gpu):
    """Of which no kernel takes the moments."""
    check_gpu(to_gpu, torch.uint8)
    check_gpu(to_gpu, torch.float64)


def check_gpu(to_gpu, dtype):
    space = [spaces.MultiImage(1, 3, 2, 8), spaces.MultiVector(1, 5), spaces.MultiVector(2, 3)]
    norms = [RunningNorm(leaf) for leaf in space]
    on_gpu = [moved(norm, to_gpu) for norm in norms]
    for seed in range(3):
        torch.manual_seed(seed)
        obs = [torch.randn(1000, *leaf.shape) * 3 + 1 for leaf in space]
        obs[0] = obs[0].abs().to(dtype)
        is_counted = torch.rand(1000) < 0.7
        obs[1][~is_counted] = torch.nan
        if seed == 1:
            obs[2][int(is_counted.nonzero()[0])] = torch.nan
        add_moments(norms, moments_of(norms, obs, is_counted))
        there = [to_gpu(leaf) for leaf in obs]
        add_moments(on_gpu, moments_of(on_gpu, there, to_gpu(is_counted)))
    add_moments(on_gpu, moments_of(on_gpu, there, False))
    add_moments(on_gpu, moments_of(on_gpu, there), to_gpu(torch.tensor(False)))
    assert [norm.count.item() for norm in on_gpu] == [3, 3, 2]
    for norm, other in zip(norms, on_gpu, strict=True):
        for name in ("mean", "scale", "count"):
            one, two = getattr(norm, name), getattr(other, name).cpu()
            torch.testing.assert_close(one, two, rtol=1e-4, atol=1e-5)
