"""Our use of PyTorch's fused Adam, against PyTorch's own class."""

import pathlib
import subprocess
import sys

import pytest
import torch

from megastep.agents.algorithms.adam import Adam

YES, NO = torch.tensor(True), torch.tensor(False)


def parameters(device="cpu"):
    generator = torch.Generator().manual_seed(0)
    shapes = ((5, 3), (5,), ())
    return [
        torch.nn.Parameter(torch.randn(shape, generator=generator).to(device)) for shape in shapes
    ]


def set_gradients(ours, *others, seed):
    generator = torch.Generator().manual_seed(seed)
    for each in zip(ours, *others):
        grad = torch.randn(each[0].shape, generator=generator)
        for p in each:
            p.grad = grad.to(p.device)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_steps_are_those_of_torchs_own_class(device):
    ours, theirs = parameters(device), parameters(device)
    lr = torch.tensor(0.1, device=device)
    adam = Adam(ours, lr, betas=(0.8, 0.99), eps=1e-4)
    how = dict(betas=(0.8, 0.99), eps=1e-4, fused=True, capturable=device == "cuda")
    own = torch.optim.Adam(theirs, lr=lr, **how)
    for seed in range(4):
        lr.fill_(0.1 / (seed + 1))
        set_gradients(ours, theirs, seed=seed)
        adam.step(YES.to(device))
        own.step()
    assert all(map(torch.equal, ours, theirs))


def test_a_step_that_is_not_taken_changes_nothing():
    left_out, without = parameters(), parameters()
    first, second = (Adam(p, torch.tensor(0.1)) for p in (left_out, without))
    for adam, takes in ((first, (YES, NO, YES)), (second, (YES, YES))):
        seeds = iter((0, 1))
        for taken in takes:
            set_gradients(adam.parameters, seed=next(seeds) if taken else 9)
            if not taken:
                adam.parameters[0].grad.fill_(torch.nan)
            adam.step(taken)
    assert all(map(torch.equal, left_out, without))
    assert first.n_steps == second.n_steps == 2
    assert all(map(torch.equal, first.squares, second.squares))


def test_a_saved_adam_goes_on():
    ours, theirs = parameters(), parameters()
    first = Adam(ours, torch.tensor(0.1))
    set_gradients(ours, seed=0)
    first.step(YES)
    second = Adam(theirs, torch.tensor(0.1))
    second.load_state_dict(first.state_dict())
    for a, b in zip(theirs, ours):
        a.data.copy_(b.data)
    set_gradients(ours, theirs, seed=1)
    first.step(YES)
    second.step(YES)
    assert all(map(torch.equal, ours, theirs))


def test_an_update_does_not_import_pytorchs_compiler():
    # It takes more than a second, before the first update.
    script = """
import sys, torch
from megastep.agents.networks.policy import Policy
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.storage.rollout import Rollout
from megastep import spaces
obs, moves = spaces.MultiVector(1, 2), spaces.MultiDiscrete(1, 3)
policy = Policy(obs, moves, width=4)
PPO(policy, n_minibatches=1).update(Rollout(2, 3, obs, moves, policy.initial(3)))
sys.exit("torch._dynamo" in sys.modules)
"""
    root = pathlib.Path(__file__).parents[2]
    assert subprocess.run([sys.executable, "-c", script], cwd=root, timeout=120).returncode == 0
