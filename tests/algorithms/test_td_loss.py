"""R2D2's fused loss on a GPU against its plain form, which test_r2d2.py checks by hand."""

import pytest
import torch

from megastep import spaces
from megastep.agents.algorithms.r2d2 import td_loss
from megastep.agents.networks import heads
from megastep.arrdict import arrdict

SETTINGS = dict(gamma=0.97, return_steps=10, eta=0.7)


def case(n_steps, n_sequences, n_agents, n_choices, to):
    """Returns action values of both networks, a minibatch and the output."""
    generator = torch.Generator().manual_seed(0)
    shape = n_steps, n_sequences

    def flags(chance, *lead):
        return torch.rand(*(lead or shape), generator=generator) < chance

    terminal = flags(0.05)
    truncated = flags(0.05) & ~terminal
    starts = flags(0.02, n_steps + 1, n_sequences)
    starts[1:-1] |= (terminal | truncated)[:-1]
    with_last = n_steps + 1, n_sequences, n_agents, n_choices
    q, target_q = 3 * torch.randn(2, *with_last, generator=generator)
    batch = arrdict(
        actions=torch.randint(n_choices, (*shape, n_agents), generator=generator),
        reward=torch.randn(shape, generator=generator),
        terminal=terminal,
        truncated=truncated,
        starts=starts,
        learns=flags(0.9, n_steps + 1, n_sequences),
        weight=torch.rand(n_sequences, generator=generator),
        age=torch.randint(9, (n_sequences,), generator=generator),
    )
    output = heads.output(spaces.MultiDiscrete(n_agents, n_choices), 8, "duelling")
    parts = to(q).requires_grad_(), to(target_q), batch.map(to)
    return *parts, output


@pytest.mark.parametrize(
    "sizes", [(1, 1, 1, 2), (32, 1000, 1, 7), (40, 9, 2, 3), (70, 17, 1, 8)], ids=str
)
def test_fused_loss_matches_plain(sizes, to_gpu):
    results = []
    for to in (to_gpu, torch.Tensor.cpu):
        q, *rest = case(*sizes, to)
        loss, metrics, priorities, n_valid = td_loss(q, *rest, **SETTINGS)
        (gradient,) = torch.autograd.grad(3 * loss, q)
        rest = dict(loss=loss, priorities=priorities, n_valid=n_valid, gradient=gradient)
        results.append(metrics | rest)
    for name, fused in results[0].items():
        # float32 sums in another order
        close = dict(rtol=1e-4, atol=1e-5, check_dtype=False)
        close["msg"] = lambda text, name=name: f"{name}: {text}"
        torch.testing.assert_close(fused.detach().cpu(), results[1][name].detach(), **close)


def test_same_bits_each_time(to_gpu):
    q, *rest = case(32, 100, 1, 7, to_gpu)
    runs = [td_loss(q, *rest, **SETTINGS) for _ in range(2)]
    gradients = [torch.autograd.grad(run.loss, q)[0] for run in runs]
    assert torch.equal(*gradients) and torch.equal(runs[0].priorities, runs[1].priorities)


def test_nan_reaches_loss_and_its_own_priority_only(to_gpu):
    q, *rest = case(12, 20, 1, 3, to_gpu)
    rest[1]["reward"][4, 7] = torch.nan
    rest[1]["starts"][5, 7], rest[1]["learns"][4, 7] = False, True
    result = td_loss(q, *rest, **SETTINGS)
    is_nan = result.priorities.isnan()
    assert result.loss.isnan() and is_nan[7] and is_nan.sum() == 1


def test_without_valid_steps_nothing_is_learned(to_gpu):
    q, *rest = case(5, 6, 1, 3, to_gpu)
    rest[1]["learns"][:] = False
    result = td_loss(q, *rest, **SETTINGS)
    assert not result.loss and not result.n_valid and not result.priorities.any()
    assert not torch.autograd.grad(result.loss, q)[0].any()
