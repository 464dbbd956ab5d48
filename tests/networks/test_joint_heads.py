"""The heads of an update together, on a GPU, against their plain forms. Kernels run on a CPU, too
(`tests/helpers/cuda_on_cpu.py`).
"""

import pytest
import torch

from megastep import spaces
from megastep.agents.networks import heads, joint_heads
from megastep.agents.networks.critic import Critic
from megastep.agents.networks.kernels import heads as kernels
from megastep.agents.networks.policy import Policy
from megastep.arrdict import arrdict

BF16 = torch.bfloat16


# one row; a last strip that is short, two words of hidden units per thread, and a word of scores of
# two agents; more than 32 words of prediction; more choices than acting takes
CASES = [
    (1, kernels.Sizes(3, 1, 7, 8)),
    (300, kernels.Sizes(52, 2, 5, 264)),
    (129, kernels.Sizes(300, 1, 7, 64)),
    (1000, kernels.Sizes(8, 3, 12, 256)),
]


@pytest.mark.parametrize("n_rows, sizes", CASES)
def test_kernels_match_pytorch_on_the_same_product(to_gpu, n_rows, sizes):
    torch.manual_seed(0)
    first_score, first_hidden, n_columns = sizes.starts
    shape, n_scores = (sizes.n_agents, sizes.n_choices), sizes.n_agents * sizes.n_choices
    columns = to_gpu(torch.randn(n_rows, n_columns).to(BF16))
    target = to_gpu(torch.randn(n_rows, first_score).to(BF16))
    actions = to_gpu(torch.randint(sizes.n_choices, (n_rows, sizes.n_agents)))
    value = kernels.Value(
        to_gpu(torch.randn(1, sizes.width)),
        to_gpu(torch.randn(1)),
        to_gpu(torch.tensor(2.5)),
        to_gpu(torch.tensor(-1.5)),
    )
    leaves = columns.float(), value.weight.clone(), value.bias.clone()
    x, weight, bias = (leaf.requires_grad_() for leaf in leaves)
    logits = x[:, first_score : first_score + n_scores].unflatten(-1, shape).log_softmax(-1)
    error = x[:, : sizes.n_predicted] - target[:, : sizes.n_predicted].float()
    hidden = x[:, first_hidden:].relu()
    expected = dict(
        logprobs=logits.gather(-1, actions[..., None]).sum((-1, -2)),
        entropies=-(logits.exp() * logits).sum((-1, -2)),
        errors=error.square().mean(-1),
        values=((hidden * weight).sum(-1) + bias) * value.scale + value.mean,
    )
    results = kernels.forward(columns, target, actions, value, sizes)
    for (name, plain), fused in zip(expected.items(), results, strict=True):
        torch.testing.assert_close(fused, plain, rtol=1e-4, atol=1e-4, msg=name)
    alone = kernels.values(columns[:, first_hidden:].contiguous(), value)
    assert torch.equal(alone, results[-1])

    gradients = to_gpu(torch.randn(4, n_rows))
    loss = sum((d * plain).sum() for d, plain in zip(gradients, expected.values()))
    d_x, d_weight, d_bias = torch.autograd.grad(loss, (x, weight, bias))
    arguments = columns, target, actions, value, sizes, tuple(gradients)
    fused = kernels.backward(*arguments)
    torch.testing.assert_close(fused[0].float(), d_x, rtol=2**-8, atol=1e-5)
    sums = dict(rtol=1e-4, atol=1e-4 * n_rows**0.5)
    # the sums of the scores' columns are of numbers that were rounded
    rounded = dict(rtol=1e-4, atol=2e-2 * n_rows**0.5)
    torch.testing.assert_close(fused[1], d_x.sum(0), **rounded)
    torch.testing.assert_close(fused[1][first_hidden:], d_x[:, first_hidden:].sum(0), **sums)
    torch.testing.assert_close(fused[2], d_weight, **sums)
    torch.testing.assert_close(fused[3], d_bias, **sums)
    for one, other in zip(fused, kernels.backward(*arguments), strict=True):
        assert torch.equal(one, other)  # the same bits again


def test_nan_of_a_row_stays_in_it(to_gpu):
    sizes = kernels.Sizes(3, 1, 7, 64)
    first_score, _, n_columns = sizes.starts
    columns = to_gpu(torch.randn(40, n_columns).to(BF16))
    target = to_gpu(torch.randn(40, first_score).to(BF16))
    actions = to_gpu(torch.zeros(40, 1, dtype=torch.int64))
    value = kernels.Value(*(to_gpu(torch.ones(shape)) for shape in ((1, 64), (1,), (), ())))
    clean = kernels.forward(columns, target, actions, value, sizes)
    columns[5] = torch.nan
    for one, other in zip(kernels.forward(columns, target, actions, value, sizes), clean):
        assert one[5].isnan() and torch.equal(one[6:], other[6:])
        assert torch.equal(one[:5], other[:5])


@pytest.mark.cuda
def test_value_without_a_gradient_matches_the_plain_form():
    torch.manual_seed(0)
    critic = Critic(64, spaces.MultiVector(1, 12)).cuda()
    torch.nn.init.normal_(critic.output.linear.weight)
    critic.output.scale.fill_(3.0)
    features, privileged = torch.randn(5, 9, 64).cuda(), torch.randn(5, 9, 1, 12).cuda()
    with torch.no_grad():
        plain = critic(features, privileged)
        with torch.autocast("cuda", BF16):
            assert critic.output.is_fused(features)
            fused = critic(features, privileged)
    assert fused.dtype == torch.float32 and fused.shape == (5, 9)
    torch.testing.assert_close(fused, plain, rtol=0, atol=0.02 * plain.abs().max().item())


@pytest.mark.cuda
def test_other_heads_are_not_fused():
    obs = spaces.MultiVector(1, 4)
    privileged = spaces.MultiVector(1, 8)
    moves = spaces.MultiDiscrete(1, 3)
    features, encoded = torch.randn(2, 3, 64).cuda().to(BF16), torch.randn(2, 3, 8).cuda().to(BF16)
    policy = Policy(obs, moves, privileged, width=64).cuda()
    assert joint_heads.fit(policy.output, policy.critic, features, encoded)
    assert not joint_heads.fit(policy.output, policy.critic, features.float(), encoded)
    plain = Policy(obs, moves, privileged, width=64, critic="plain").cuda()
    assert not joint_heads.fit(plain.output, plain.critic, features, encoded)
    for space in (spaces.MultiContinuous(1, 2), arrdict(one=moves)):
        output = heads.output(space, 64).cuda()
        assert not joint_heads.fit(output, policy.critic, features, encoded)
