"""Gradient steps: which are taken, what is counted, and Adam against torch.optim."""

import math

import pytest
import torch

from megastep.agents.algorithms import gradient_steps
from megastep.agents.algorithms.gradient_steps import GradientSteps, average_gradients
from megastep.agents.algorithms.optimizers import BETAS, EPS, Adam, has_kernels
from megastep.agents.distributed import pooling


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


def averages(patch, move=torch.clone):
    """Returns what the second of two ranks gets: gradients, metrics and the number of entries."""
    generator, buckets = torch.Generator().manual_seed(0), []

    def all_reduce(bucket):
        buckets.append(bucket.clone())
        return bucket.copy_(sum(buckets))

    patch.setattr(pooling, "all_reduce", all_reduce)
    patch.setattr(pooling, "n_pooled", lambda: 2)
    for n_valid in (3, 5):
        numbers = [torch.randn(n + 1, generator=generator) for n in [*range(60), 5000]]
        params = [torch.nn.Parameter(move(torch.zeros(n - n % 2))) for n in map(len, numbers)]
        for p, gradient in zip(params[:-1], numbers):  # the last has none; odd ones begin anywhere
            p.grad = move(gradient)[len(gradient) % 2 :]
        metrics = [move(torch.randn((), generator=generator)) for _ in range(2)]
        n, means = average_gradients(params, move(torch.tensor(n_valid)), metrics)
    assert params[-1].grad is None
    return [*(p.grad for p in params[:-1]), *means, n]


def test_a_gpu_averages_gradients_as_a_cpu_does(to_gpu, monkeypatch):
    """Bit for bit. Also with more parameters than fit into a launch."""
    on_gpu, on_cpu = (averages(monkeypatch, move) for move in (to_gpu, torch.clone))
    assert on_gpu[-1] == on_cpu[-1] == 8 and len(on_gpu) == 63
    for one, other in zip(on_gpu, on_cpu, strict=True):
        assert torch.equal(one.cpu().float(), other)


# ---- Adam ----

YES, NO = torch.tensor(True), torch.tensor(False)


def parameters(device="cpu"):
    generator = torch.Generator().manual_seed(0)
    shapes = ((5, 3), (5,), ())
    return [
        torch.nn.Parameter(torch.randn(shape, generator=generator).to(device)) for shape in shapes
    ]


def set_gradients(*parameter_lists, seed):
    """Gives every list of parameters the same random gradients."""
    generator = torch.Generator().manual_seed(seed)
    for parameters in zip(*parameter_lists):
        grad = torch.randn(parameters[0].shape, generator=generator)
        for p in parameters:
            p.grad = grad.to(p.device, copy=True)


def assert_equal(params, others):
    """Bit for bit on a CPU; on a GPU our kernel uses fused multiply-adds elsewhere."""
    close = dict(rtol=1e-5, atol=1e-6) if params[0].is_cuda else dict(rtol=0, atol=0)
    for p, other in zip(params, others, strict=True):
        torch.testing.assert_close(p, other, **close)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_matches_torch_optim_adamw(device):
    """Only the matrix decays, and the vector has three times the step size."""
    params, torch_params = parameters(device), parameters(device)
    lr = torch.tensor(0.1, device=device)
    adam = Adam(params, lr, lr_factors={params[1]: 3.0}, weight_decays={params[0]: 0.5})
    options = dict(betas=BETAS, eps=EPS, fused=True, capturable=device == "cuda")
    torch_adams = [
        torch.optim.AdamW([p], lr=lr.clone(), weight_decay=decay, **options)
        for p, decay in zip(torch_params, (0.5, 0.0, 0.0))
    ]
    for seed in range(4):
        lr.fill_(0.1 / (seed + 1))
        set_gradients(params, torch_params, seed=seed)
        adam.step(YES.to(device), adam.grad_norm(), math.inf)
        for torch_adam, factor in zip(torch_adams, (1, 3, 1)):
            torch_adam.param_groups[0]["lr"].copy_(lr * factor)
            torch_adam.step()
    assert_equal(params, torch_params)


def test_skipped_step_changes_nothing():
    skipping, plain = parameters(), parameters()
    first, second = (Adam(p, torch.tensor(0.1)) for p in (skipping, plain))
    for adam, steps in ((first, (YES, NO, YES)), (second, (YES, YES))):
        seeds = iter((0, 1))
        for is_taken in steps:
            set_gradients(adam.parameters, seed=next(seeds) if is_taken else 9)
            if not is_taken:
                adam.parameters[0].grad.fill_(torch.nan)
            adam.step(is_taken, adam.grad_norm(), math.inf)
    assert all(map(torch.equal, skipping, plain))
    assert first.n_steps == second.n_steps == 2
    assert all(map(torch.equal, first.squares, second.squares))


@pytest.mark.cuda
def test_learners_on_streams_of_their_own_wait_for_no_other():
    """The first one's stream is busy, with what the others read if nobody made it before."""
    streams = [torch.cuda.Stream() for _ in range(2)]
    params = [torch.nn.Parameter(torch.ones(3, device="cuda")) for _ in streams]
    with torch.cuda.stream(streams[0]):
        torch.full((), 7.0, device="cuda")  # is freed, and in that place it would be
    gradient_steps.one.cache_clear()
    learners = [GradientSteps([p], 0.1, 0.5, p.device) for p in params]
    n_valid = torch.tensor(3, device="cuda")
    torch.cuda.synchronize()
    for i, stream in enumerate(streams):
        with torch.cuda.stream(stream):
            if i == 0:
                torch.cuda._sleep(10**9)
            learners[i].backward((2 * params[i]).sum(), {}, n_valid)
    torch.cuda.synchronize()
    assert all(p.grad.eq(2).all() for p in params)
