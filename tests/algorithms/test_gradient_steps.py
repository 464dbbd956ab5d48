"""Gradient steps: which are taken, and what is counted."""

import math

import pytest
import torch

from megastep.agents.algorithms.gradient_steps import GradientSteps
from megastep.agents.algorithms.optimizers import has_kernels


def updates(to=torch.Tensor.cpu):
    """Makes three updates of four steps. Returns the metrics of each, and the end's tensors.

    Args:
        to: moves a tensor.
    """
    generator = torch.Generator().manual_seed(0)
    sizes = [*range(1, 60), 5000]  # more parameters than fit into a launch
    weights = [torch.randn(n, generator=generator) for n in sizes]
    params = [torch.nn.Parameter(to(weight)) for weight in weights]
    steps = GradientSteps(params, 0.1, 0.5, params[0].device, weight_decays={params[3]: 0.3})
    metrics = []
    for update in range(3):
        reward = to(torch.full((2, 2), torch.nan if update == 2 else 1.0))
        steps.begin({"reward": reward})
        for k in range(4):
            factors = to(torch.randn(len(sizes), generator=generator))
            loss = sum(p.square().sum() * factor for p, factor in zip(params, factors))
            n_valid, is_enabled = to(torch.tensor(3)), True
            if (update, k) == (0, 1):
                n_valid -= 3
            if (update, k) == (1, 2):
                loss = loss * torch.nan
            if k == 3:
                is_enabled = to(torch.tensor(update == 0))
            named = dict(k=to(torch.tensor(float(k))), loss=loss.detach())
            steps.backward(loss, named, n_valid)
            for p in params:
                p.grad = to(p.grad)
            assert has_kernels(steps.optimizer) == params[0].is_cuda
            steps.take(is_enabled)
        metrics.append({name: value.item() for name, value in steps.end().items()})
    return metrics, [*params, *steps.optimizer.squares, steps.optimizer.n_steps, steps.check.record]


def test_only_good_steps_are_taken():
    metrics, (*_, n_steps, record) = updates()
    # steps 0, 2 and 3; steps 0 and 1; none
    assert [one["k"] for one in metrics[:2]] == pytest.approx([5 / 3, 1 / 2])
    assert math.isnan(metrics[2]["k"])
    assert [one["skipped_steps"] for one in metrics] == [0, 1, 3]
    assert n_steps == 5 and record[:2].tolist() == [3, 1]


def test_a_gpu_takes_the_same_steps(to_gpu):
    (metrics, tensors), (expected, of_cpu) = updates(to_gpu), updates()
    for one, other in zip(metrics, expected, strict=True):
        assert one == pytest.approx(other, rel=1e-4, nan_ok=True)
    for one, other in zip(tensors, of_cpu, strict=True):
        torch.testing.assert_close(one.cpu(), other, rtol=1e-4, atol=1e-5)
