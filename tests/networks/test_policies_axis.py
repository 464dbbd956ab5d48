"""Kernels with weights or statistics take several policies: each gets what it gets alone."""

import pytest
import torch

from megastep.agents.algorithms.adam import Adam
from megastep.agents.algorithms.kernels.program import N_SUMS, n_blocks
from megastep.agents.algorithms.kernels.program import PROGRAM as ALGORITHMS
from megastep.agents.algorithms.ppo_loss import Coefficients, ppo_loss
from megastep.agents.networks.kernels import duelling, layers
from megastep.agents.networks.kernels.program import CORES
from megastep.arrdict import arrdict
from megastep.kernels.build.launch import BLOCK, WARP, launch_blocks

pytestmark = pytest.mark.cuda
P = 3
BF16 = torch.bfloat16


def launch(program, operation, n_blocks, n_threads=BLOCK, **fields):
    """Launches an operation; a tensor stands for its address."""
    values = {
        name: field.data_ptr() if isinstance(field, torch.Tensor) else field
        for name, field in fields.items()
    }
    pack = getattr(program.params, program.cuda_operations[operation])
    device = torch.device("cuda", torch.cuda.current_device())
    launch_blocks(program, operation, pack(**values), device, n_blocks, n_threads)


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def randn(*shape):
    return torch.randn(P, *shape, device="cuda")


def test_intake():
    n_steps, n_lanes, n_columns = 4, 9, 24
    leaves = [randn(n_steps, n_lanes, 16).half(), randn(n_steps, n_lanes, 5)]
    means, scales = [randn(4), randn(5)], [randn(4).abs() + 0.1, randn(5).abs() + 0.1]
    lanes = torch.stack([torch.randperm(n_lanes, device="cuda")[:7] for _ in range(P)])
    features = torch.empty(P, n_steps, 7, n_columns, dtype=BF16, device="cuda")
    packed = [
        CORES.params.IntakeLeafParams(
            values=leaf.data_ptr(),
            mean=mean.data_ptr(),
            scale=scale.data_ptr(),
            n_features=leaf.shape[-1],
            group=leaf.shape[-1] // mean.shape[-1],
            is_half=int(leaf.dtype == torch.float16),
        )
        for leaf, mean, scale in zip(leaves, means, scales, strict=True)
    ]
    n_threads = n_columns // 4 * -(-7 // CORES.constants["NORMALISED_ROWS"])
    launch(
        *(CORES, "normalise_bfloat16", (-(-n_threads // BLOCK), P * n_steps)),
        leaves=b"".join(packed),
        lanes=lanes,
        features=features,
        n_steps=n_steps,
        n_lanes=n_lanes,
        n_selected=7,
        n_columns=n_columns,
        n_plain_words=4,
    )
    for i in range(P):
        of_policy = ([leaf[i] for leaf in parts] for parts in (leaves, means, scales))
        alone = layers.normalise(*of_policy, n_columns, BF16, lanes[i])
        assert torch.equal(features[i], alone), i


@pytest.mark.parametrize("n_columns", [8, 264])  # 264: two blocks of columns
def test_bias_gradient(n_columns):
    n_rows, strip = 300, CORES.constants["STRIP"]
    n_strips = -(-n_rows // strip)
    d, activated = randn(n_rows, n_columns).to(BF16), randn(n_rows, n_columns).to(BF16).relu()
    d_masked, sums = torch.empty_like(d), randn(n_strips, n_columns)
    launch(
        *(CORES, "bias_gradient_bfloat16", (n_strips, P * -(-n_columns // (8 * WARP)))),
        CORES.constants["STRIP_THREADS"],
        d=d,
        activated=activated,
        d_masked=d_masked,
        sums=sums,
        n_rows=n_rows,
        n_columns=n_columns,
        n_strips=n_strips,
    )
    for i in range(P):
        masked, total = layers.bias_gradient(d[i], activated[i])
        assert torch.equal(d_masked[i], masked), i
        torch.testing.assert_close(sums[i].sum(0), total)


def test_categorical_actions():
    n_lanes, width, shape = 37, 64, (2, 5)
    features, noise = randn(n_lanes, width).to(BF16), randn(n_lanes, *shape).abs()
    weight, bias = randn(10, width).to(BF16), randn(10).to(BF16)
    logits, logprobs = randn(n_lanes, *shape), randn(n_lanes)
    actions = torch.empty(P, n_lanes, shape[0], dtype=torch.int64, device="cuda")
    n_threads = CORES.constants["ACT_THREADS"] * n_lanes
    launch(
        *(CORES, "categorical_act_bfloat16", (-(-n_threads // BLOCK), P)),
        features=features,
        weight=weight,
        bias=bias,
        noise=noise,
        logits=logits,
        actions=actions,
        logprobs=logprobs,
        n_lanes=n_lanes,
        width=width,
        n_agents=shape[0],
        n_choices=shape[1],
    )
    for i in range(P):
        alone = layers.act(features[i], weight[i], bias[i], shape, noise[i])
        for one, other in zip((logits[i], actions[i], logprobs[i]), alone, strict=True):
            assert torch.equal(one, other), i


def test_adam():
    """Each policy has its own step size, count of steps and norm; one takes no step."""
    shapes = (5, 3), (70_000,), (1,)
    weights = [randn(*shape) for shape in shapes]
    gradients = [randn(*shape) for shape in shapes]
    moments = [[randn(*shape).abs() for shape in shapes] for _ in range(2)]
    lr, max_norm = torch.tensor([0.1, 0.01, 0.3], device="cuda"), 0.7
    n_steps = torch.tensor([3.0, 8.0, 1.0], device="cuda")
    is_taken = torch.tensor([True, True, False], device="cuda")
    alone, norms = [], []
    for i in range(P):
        params = [torch.nn.Parameter(weight[i].clone()) for weight in weights]
        adam = Adam(params, lr[i].clone(), weight_decays={params[0]: 0.1})
        adam.n_steps.fill_(n_steps[i] - is_taken[i].float())
        for kept, values in zip((adam.means, adam.squares), moments, strict=True):
            for target, value in zip(kept, values, strict=True):
                target.copy_(value[i])
        for param, gradient in zip(params, gradients, strict=True):
            param.grad = gradient[i].clone()
        norms.append(adam.grad_norm())
        adam.step(is_taken[i].clone(), norms[-1], max_norm)
        alone.append([*(p.detach() for p in params), *adam.means, *adam.squares])

    rows, n = [], 0
    for at, row in enumerate(zip(weights, gradients, *moments, strict=True)):
        names = "parameter", "gradient", "mean", "square"
        rows.append(
            ALGORITHMS.params.AdamRowParams(
                **{name: leaf.data_ptr() for name, leaf in zip(names, row, strict=True)},
                n=row[0][0].numel(),
                first_block=n,
                lr_factor=1.0,
                weight_decay=0.0 if at else 0.1,
            )
        )
        n += -(-row[0][0].numel() // (BLOCK * ALGORITHMS.constants["ADAM_NUMBERS"]))
    packed, sums = dict(rows=b"".join(rows), n_rows=len(rows)), randn(n)
    launch(ALGORITHMS, "squared_norm", (n, P), sums=sums, **packed)
    grad_norm = sums.sum(1).sqrt()
    torch.testing.assert_close(grad_norm, torch.stack(norms))
    launch(
        *(ALGORITHMS, "adam", (n, P)),
        **packed,
        lr=lr,
        n_steps=n_steps,
        grad_norm=torch.stack(norms),
        is_taken=is_taken,
        max_norm=max_norm,
        beta1=0.9,
        beta2=0.999,
        eps=1e-5,
    )
    for i in range(P):
        for one, other in zip([*weights, *moments[0], *moments[1]], alone[i], strict=True):
            assert torch.equal(one[i], other), i


def test_ppo_loss():
    n_steps, n_lanes = 5, 61
    n_rows, settings = n_steps * n_lanes, Coefficients(0.2, 0.3, 0.5, 0.01, 0.7)
    names = "logprobs", "entropies", "values", "errors"
    inputs = {name: randn(n_steps, n_lanes) for name in names}
    batch = arrdict(
        logprobs=inputs["logprobs"] + 0.3 * randn(n_steps, n_lanes),
        old_value=randn(n_steps, n_lanes),
        advantages=randn(n_steps, n_lanes),
        targets=randn(n_steps, n_lanes),
        valid=randn(n_steps, n_lanes) > -1,
    )
    value_scale = randn().abs() + 0.5
    gradients = {f"d_{name}": randn(n_steps, n_lanes) for name in names}
    sums = randn(n_blocks(n_rows), N_SUMS)
    n_valid = batch.valid.sum((1, 2))
    launch(
        *(ALGORITHMS, "ppo_loss", (n_blocks(n_rows), P)),
        **inputs,
        old_logprobs=batch.logprobs,
        old_values=batch.old_value,
        advantages=batch.advantages,
        targets=batch.targets,
        valid=batch.valid,
        n_valid=n_valid,
        value_scale=value_scale,
        **gradients,
        sums=sums,
        n_rows=n_rows,
        **settings._asdict(),
    )
    for i in range(P):
        leaves = [inputs[name][i].clone().requires_grad_() for name in names]
        loss, metrics = ppo_loss(*leaves, batch[i], value_scale[i], settings)
        alone = torch.autograd.grad(loss, leaves)
        for one, other in zip(gradients.values(), alone, strict=True):
            assert torch.equal(one[i], other), i
        means = torch.stack([*metrics.values()])
        torch.testing.assert_close(sums[i].sum(0) / n_valid[i], means)


def test_duelling():
    n_rows, width, shape = 21, 16, (2, 3)
    hidden = randn(n_rows, 2 * width).relu().to(BF16)
    weights = randn(2, width), randn(2), randn(6, width), randn(6)
    names = "value_weight", "value_bias", "advantage_weight", "advantage_bias"
    noise = torch.rand(2, P, n_rows, 2, device="cuda")
    epsilon = torch.rand(P, n_rows, device="cuda")
    values, logprobs = randn(n_rows, *shape), randn(n_rows)
    actions = torch.empty(P, n_rows, 2, dtype=torch.int64, device="cuda")
    launch(
        *(CORES, "duelling_act", (-(-n_rows // 8), P)),
        **dict(zip(names, weights, strict=True)),
        **dict(hidden=hidden, noise=noise, epsilon=epsilon, values=values),
        **dict(actions=actions, logprobs=logprobs, n_rows=n_rows, width=width),
        **dict(n_agents=2, n_choices=3, usual_epsilon=0.05),
    )
    d_values, d_hidden = randn(n_rows, *shape), torch.empty_like(hidden)
    sums = randn(1, (2 + 2 + 6) * width + 8)
    launch(
        *(CORES, "duelling_backward", (1, P), CORES.constants["DUELLING_THREADS"]),
        **dict(hidden=hidden, value_weight=weights[0], advantage_weight=weights[2]),
        **dict(d_values=d_values, d_hidden=d_hidden, sums=sums, n_rows=n_rows, width=width),
        **dict(n_agents=2, n_choices=3, n_parts=1, n_sums=sums.shape[-1]),
    )
    for i in range(P):
        own = [weight[i] for weight in weights]
        alone = duelling.act(hidden[i], own, shape, noise[:, i].contiguous(), epsilon[i], 0.05)
        for one, other in zip((values, actions, logprobs), alone, strict=True):
            assert torch.equal(one[i], other), i
        gradients = duelling.backward(hidden[i], own[0], own[2], d_values[i])
        assert torch.equal(d_hidden[i], gradients[0]), i
        assert torch.equal(sums[i, 0, : 2 * width], gradients[1][0]), i
