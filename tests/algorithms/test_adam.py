"""Adam against torch.optim."""

import pytest
import torch

from megastep.agents.algorithms.optimizers import Adam, has_kernels

YES, NO = torch.tensor(True), torch.tensor(False)


def parameters(device="cpu"):
    generator = torch.Generator().manual_seed(0)
    shapes = ((5, 3), (5,), ())
    return [
        torch.nn.Parameter(torch.randn(shape, generator=generator).to(device)) for shape in shapes
    ]


def set_gradients(*parameter_lists, seed, move=torch.clone):
    """Gives every list of parameters the same random gradients."""
    generator = torch.Generator().manual_seed(seed)
    for parameters in zip(*parameter_lists):
        grad = torch.randn(parameters[0].shape, generator=generator)
        for p in parameters:
            p.grad = move(grad).to(p.device)


def assert_equal(params, others):
    """Bit for bit on a CPU; on a GPU our kernel uses fused multiply-adds elsewhere."""
    close = dict(rtol=1e-5, atol=1e-6) if params[0].is_cuda else dict(rtol=0, atol=0)
    for p, other in zip(params, others, strict=True):
        torch.testing.assert_close(p, other, **close)


def test_gradients_are_clipped_on_a_gpu_as_on_a_cpu(to_gpu):
    """Also with more parameters than fit into a launch."""
    results = []
    for move in (torch.clone, to_gpu):
        generator = torch.Generator().manual_seed(0)
        params = [
            torch.nn.Parameter(move(torch.randn(n, generator=generator)))
            for n in [*range(1, 60), 5000]
        ]
        adam = Adam(params, move(torch.tensor(0.1)))
        for seed in range(3):
            set_gradients(params, seed=seed, move=move)
            assert has_kernels(adam) == (move is to_gpu)
            norm = adam.grad_norm()
            adam.step(move(YES), norm, 0.5)
            set_gradients(params, seed=9, move=move)
            adam.step(move(NO), norm, 0.5)
        results.append([norm, *params, *adam.squares])
    for fused, plain in zip(results[1], results[0], strict=True):
        torch.testing.assert_close(fused.cpu(), plain, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_matches_torch_optim_adamw(device):
    """Only the matrix decays, and the vector has three times the step size."""
    params, torch_params = parameters(device), parameters(device)
    lr = torch.tensor(0.1, device=device)
    options = dict(betas=(0.8, 0.99), eps=1e-4)
    adam = Adam(params, lr, lr_factors={params[1]: 3.0}, weight_decays={params[0]: 0.5}, **options)
    options |= dict(fused=True, capturable=device == "cuda")
    torch_adams = [
        torch.optim.AdamW([p], lr=lr.clone(), weight_decay=decay, **options)
        for p, decay in zip(torch_params, (0.5, 0.0, 0.0))
    ]
    for seed in range(4):
        lr.fill_(0.1 / (seed + 1))
        set_gradients(params, torch_params, seed=seed)
        adam.step(YES.to(device))
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
            adam.step(is_taken)
    assert all(map(torch.equal, skipping, plain))
    assert first.n_steps == second.n_steps == 2
    assert all(map(torch.equal, first.squares, second.squares))
