"""The heads of an update together, by their kernels, against PyTorch: on a GPU, and on a CPU that
stands for one.
"""

import functools

import pytest
import torch

from megastep import spaces
from megastep.agents.networks import critic as critic_module
from megastep.agents.networks import heads
from megastep.agents.networks import linear as linear_module
from megastep.agents.networks.critic import Critic
from megastep.agents.networks.fused import plain_operations
from tests.helpers.weights import moved

BF16 = torch.bfloat16
# rows, predicted numbers, agents, choices, width: one row; a last strip that is short, and two
# words of hidden units per thread; more than 32 words of prediction; more choices than acting
# takes; plain critics, without a prediction
CASES = [(1, 3, 1, 7, 8), (300, 52, 2, 5, 264), (129, 300, 1, 7, 64), (1000, 8, 3, 12, 256)]
CASES += [(1, 0, 1, 7, 8), (300, 0, 2, 5, 264)]


def modules(n_predicted, n_agents, n_choices, width):
    """Returns an output, a critic and a prediction, with weights far from 0."""
    output = heads.output(spaces.MultiDiscrete(n_agents, n_choices), width)
    critic = Critic(width, spaces.MultiVector(1, n_predicted) if n_predicted else None)
    prediction = torch.nn.Linear(width, n_predicted) if n_predicted else None
    for module in (output, critic, prediction):
        for leaf in module.parameters() if module else ():
            torch.nn.init.normal_(leaf, std=leaf.shape[-1] ** -0.5)
            leaf.data = leaf.data.bfloat16().float()
    critic.output.scale.fill_(2.5)
    critic.output.mean.fill_(-1.5)
    return output, critic, prediction


@pytest.fixture
def products(monkeypatch):
    """A CPU has neither products of few rows, nor those of bfloat16 with results in float32."""
    monkeypatch.setattr(linear_module.few_rows, "fits", lambda *matrices: False)
    if not torch.cuda.is_available():
        for module in (linear_module, critic_module):
            monkeypatch.setattr(module, "gradient_of_weights", lambda d, x: d.float().T @ x.float())


@pytest.mark.parametrize("n_rows, n_predicted, n_agents, n_choices, width", CASES)
def test_terms_and_gradients_match_pytorch(
    to_gpu, products, n_rows, n_predicted, n_agents, n_choices, width
):
    torch.manual_seed(0)
    plain = modules(n_predicted, n_agents, n_choices, width)
    features, encoded = torch.randn(n_rows, width).to(BF16), None
    if n_predicted:
        encoded = torch.randn(n_rows, plain[1].intake.project.in_features).to(BF16)
    actions = torch.randint(n_choices, (n_rows, n_agents))
    weights = torch.randn(4, n_rows)
    results = []
    for is_fused in (True, False):
        if is_fused:
            of = [module and moved(module, to_gpu) for module in plain]
            x, *others = (
                leaf if leaf is None else to_gpu(leaf) for leaf in (features, encoded, actions)
            )
            x.requires_grad_()
            with torch.autocast(x.device.type, BF16):
                _, started = critic_module.start_heads(*of, functools.partial(next, iter(others)))
                inputs = *of, x, *others, None, started
                assert critic_module._fits_joint(*inputs) == x.is_cuda
                terms = critic_module._terms_on_gpu(*inputs)
        else:
            of, x = plain, features.float().requires_grad_()
            with plain_operations():
                target = None if encoded is None else encoded.float()
                terms = critic_module.head_terms(*of, x, target, actions)
        loss = sum(
            (w.to(x.device) * term).sum() for w, term in zip(weights, terms) if term is not None
        )
        leaves = [x, *(leaf for module in of if module for leaf in module.parameters())]
        d = torch.autograd.grad(loss, leaves, allow_unused=True)
        results.append([*terms, *d])
    for i, (ours, theirs) in enumerate(zip(*results, strict=True)):
        assert (ours is None) == (theirs is None)
        if theirs is not None:
            error = (ours.float().cpu() - theirs).norm() / theirs.norm().clamp(min=1e-6)
            assert error < 5e-2, (i, error)  # 8 bits, and ReLUs near their kink


@pytest.mark.cuda
def test_value_without_a_gradient_matches_the_plain_form():
    torch.manual_seed(0)
    critic = Critic(64, spaces.MultiVector(1, 12)).cuda()
    torch.nn.init.normal_(critic.output.linear.weight)
    critic.output.scale.fill_(3.0)
    features, privileged = torch.randn(5, 9, 64).cuda(), torch.randn(5, 9, 1, 12).cuda()
    with torch.no_grad():
        plain = critic(features, critic.encode(privileged))
        with torch.autocast("cuda", BF16):
            fused = critic(features, critic.encode(privileged))
    assert fused.dtype == torch.float32 and fused.shape == (5, 9)
    torch.testing.assert_close(fused, plain, rtol=0, atol=0.02 * plain.abs().max().item())
