"""PPO's fused losses on a GPU against their plain forms."""

import pytest
import torch

from megastep import spaces
from megastep.agents.algorithms import ppo as ppo_module
from megastep.agents.algorithms.ppo import PPO, ppo_loss
from megastep.agents.networks import heads, linear
from megastep.agents.networks.critic import ValueOutput
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.rollout import Rollout
from megastep.arrdict import arrdict
from megastep.kernels.build.launch import launch
from tests.helpers.made_up import MOVES, OBS

T, M = 7, 133


def case(to, value_clip, auxiliary):
    generator = torch.Generator().manual_seed(0)

    def draw(spread=1.0):
        return to(spread * torch.randn(T, M, generator=generator))

    batch = arrdict(
        logprobs=draw(0.3) - 1,
        advantages=draw(),
        targets=draw(3.0),
        old_value=draw(3.0),
        valid=draw() > -1,
    )
    batch["n_valid"] = batch.valid.sum()
    leaves = [draw(0.3) - 1, draw() + 2, draw(3.0), draw() if auxiliary else None]
    leaves[0][~batch.valid] = torch.nan  # whatever is invalid does not count
    leaves = [None if leaf is None else leaf.requires_grad_() for leaf in leaves]
    settings = dict(clip=0.2, value_clip=value_clip, value_coef=0.5)
    settings |= dict(entropy_coef=0.01, auxiliary_coef=0.7)
    return leaves, batch, to(torch.tensor(2.5)), settings


def loss_of(leaves, batch, scale, settings):
    names = "logprobs", "entropies", "values", "errors"
    others = dict(batch=batch, value_scale=scale, coefficients=settings)
    return ppo_loss(**dict(zip(names, leaves)), **others)


@pytest.mark.parametrize("value_clip", [None, 0.3])
@pytest.mark.parametrize("auxiliary", [False, True])
def test_fused_loss_matches_plain(value_clip, auxiliary, to_gpu):
    results = []
    for to in (to_gpu, torch.Tensor.cpu):
        leaves, batch, scale, settings = case(to, value_clip, auxiliary)
        loss, metrics = loss_of(leaves, batch, scale, settings)
        inputs = [leaf for leaf in leaves if leaf is not None]
        gradients = torch.autograd.grad(3 * loss, inputs)
        names = sorted(metrics)
        results.append([loss, *(metrics[name] for name in names), *gradients])
        names = ["loss", *names, *range(len(inputs))]
    for name, fused, plain in zip(names, *results, strict=True):
        close = dict(rtol=1e-4, atol=1e-6, msg=lambda text, name=name: f"{name}: {text}")
        torch.testing.assert_close(fused.detach().cpu(), plain.detach(), **close)


def test_without_valid_steps_nothing_is_learned(to_gpu):
    leaves, batch, scale, settings = case(to_gpu, None, True)
    batch["valid"] = torch.zeros_like(batch.valid)
    batch["n_valid"] = batch.valid.sum()
    loss, metrics = loss_of(leaves, batch, scale, settings)
    assert not loss and not any(metrics.values())
    assert not any(gradient.any() for gradient in torch.autograd.grad(loss, leaves))


def rounded(x):
    return x + (x.bfloat16().float() - x).detach()


@pytest.mark.parametrize("sizes", [(7, 64, None), (8, 96, 0.3), (2, 256, None)], ids=str)
def test_joint_loss_matches_heads_and_loss(sizes, to_gpu, monkeypatch):
    """Losses and gradients of features and parameters, from features rounded to bfloat16."""
    torch.manual_seed(0)
    if not torch.cuda.is_available():  # a CPU has no product of bfloat16 with a float32 result
        monkeypatch.setattr(ppo_module, "gradient_of_weights", lambda d, x: d.float().T @ x.float())
    n_choices, width, value_clip = sizes
    output = heads.output(spaces.MultiDiscrete(1, n_choices), width)
    critic = ValueOutput(width)
    for leaf in (*output.parameters(), *critic.parameters()):
        leaf.data = (0.1 * torch.randn(leaf.shape)).bfloat16().float()
    critic.mean.fill_(-0.5), critic.scale.fill_(2.5)
    features = torch.randn(T, M, width).bfloat16()
    _, batch, scale, settings = case(torch.Tensor.cpu, value_clip, False)
    batch["actions"] = torch.randint(n_choices, (T, M, 1))
    results = []
    for to in (to_gpu, torch.Tensor.cpu):
        parameters = [*output.linear.parameters(), *critic.linear.parameters()]
        parameters = [to(leaf.detach().clone()).requires_grad_() for leaf in parameters]
        x = to(features if to is to_gpu else features.float()).requires_grad_()
        if to is to_gpu:
            numbers = arrdict(scale=to(critic.scale), mean=to(critic.mean))
            inputs = batch.map(to), numbers, settings, x, *parameters
            loss, means = ppo_module._JointLoss.apply(*inputs)
        else:
            weight, bias, of_value, bias_of_value = parameters
            logits = rounded(x @ weight.T + bias)[:, :, None].log_softmax(-1)
            values = rounded(x @ of_value.T + bias_of_value)[..., 0]
            values = values * critic.scale + critic.mean
            terms = output.logprob(logits, batch.actions), output.entropy(logits), values, None
            loss, metrics = loss_of(terms, batch, critic.scale, settings)
            means = torch.stack([*metrics.values()])
        results.append([loss, means[:5], *torch.autograd.grad(3 * loss, [x, *parameters])])
    for i, (fused, plain) in enumerate(zip(*results, strict=True)):
        error = (fused.detach().float().cpu() - plain).norm() / plain.norm()
        assert error < 2.5e-2, (i, error)  # 8 bits


class OnGpu(Policy):
    device = property(lambda self: torch.device("cuda"))


def test_joint_loss_is_for_weights_that_shared_memory_holds(monkeypatch):
    """That of an RTX 3090 or 4090; a 3072 x 3072 policy takes too long to make."""
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (8, 9))
    vectors, choices = spaces.MultiVector(1, 2), spaces.MultiDiscrete(1, 3)
    policy = OnGpu(vectors, choices, width=32, core="none", critic="plain")
    fitting = []
    for policy.width in range(32, 8193, 32):
        n_bytes = 32 * (policy.width + 2) + 4 * ppo_module._N_SUMS * ppo_module._THREADS // 32
        if ppo_module._takes_joint_loss(policy, {}, {}, True):
            assert n_bytes <= 99 * 1024
            fitting.append(policy.width)
    assert fitting == [*range(32, 3073, 32)]


@pytest.mark.parametrize("learning", (1.0, 0.5, 0.0))
def test_an_update_by_joint_loss_has_the_gradients_of_a_plain_one(
    learning, cuda_on_cpu, monkeypatch
):
    """Where all lanes learn, some or none; metrics too."""

    def on_cpu(library, operation, device, shape, /, **fields):
        is_ours = operation in ("joint_loss", "sum_rows")
        (cuda_on_cpu if is_ours else launch)(library, operation, device, shape, **fields)

    results = []
    for loss_of_policy in (ppo_module._loss_of, ppo_module._joint_loss):
        torch.manual_seed(1)
        policy = Policy(OBS, MOVES, width=64, core="mingru", critic="plain")
        policy.output.linear.weight.data.mul_(100)
        rollout = Rollout(T, M, OBS, MOVES, policy.initial(M), "cpu")
        for leaf in (rollout.obs, rollout.reward, rollout.values):
            leaf.normal_()
        rollout.actions.random_(MOVES.n_actions)
        rollout.logprobs.fill_(-1)
        rollout.learns.copy_(torch.rand(M) < learning)
        learner = PPO(policy, n_minibatches=1, entropy_coef=0.1)
        with monkeypatch.context() as patch:
            patch.setattr(ppo_module, "gradient_of_weights", lambda d, x: d.float().T @ x.float())
            for module in (ppo_module, linear):
                patch.setattr(module, "launch", on_cpu)
            patch.setattr(ppo_module, "_loss_of", loss_of_policy)
            metrics = learner.update(rollout)
        results.append((metrics, [leaf.grad for leaf in policy.parameters()]))
    assert "joint_loss" in cuda_on_cpu.launched
    (metrics, gradients), (joint_metrics, joint_gradients) = results
    assert metrics.keys() == joint_metrics.keys()
    close = dict(rtol=1e-2, atol=1e-2, equal_nan=True)
    for name, value in metrics.items():
        torch.testing.assert_close(joint_metrics[name], value, **close)
    for joint, plain in zip(joint_gradients, gradients, strict=True):
        assert joint.dtype == plain.dtype and joint.shape == plain.shape
        assert (joint - plain).norm() <= 2e-2 * plain.norm() + 2e-4  # a sum of many
        assert plain.any() == (learning > 0)
