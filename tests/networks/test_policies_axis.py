"""Kernels with weights or statistics take several policies: each gets what it gets alone."""

import pytest
import torch

from megastep.agents.algorithms.adam import Adam
from megastep.agents.algorithms.kernels.program import N_SUMS, n_blocks
from megastep.agents.algorithms.kernels.program import PROGRAM as ALGORITHMS
from megastep.agents.algorithms.ppo_loss import Coefficients, ppo_loss
from megastep.agents.networks.kernels import heads, layers
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


def test_statistics_of_returns():
    names = "weight", "bias", "mean", "scale", "count", "new_mean", "new_variance"
    width = 40
    leaves = {name: randn(width) if name == "weight" else randn().abs() for name in names}
    counts = torch.tensor([3, 0, 7], device="cuda")  # one policy has no returns
    alone = {name: leaf.clone() for name, leaf in leaves.items()}
    options = dict(width=width, min_rate=0.05, min_scale=1e-3)
    threads = CORES.constants["MOMENTS_THREADS"]
    launch(CORES, "add_returns", (P, 1), threads, **leaves, n_returns=counts, **options)
    for i in range(P):
        row = {name: leaf[i : i + 1] for name, leaf in alone.items()}
        before = {name: leaf.clone() for name, leaf in row.items()}
        launch(CORES, "add_returns", (1, 1), threads, **row, n_returns=counts[i : i + 1], **options)
        for name, leaf in row.items():
            assert torch.equal(leaves[name][i], leaf[0]), name
            if name in ("weight", "bias", "mean", "count"):
                assert torch.equal(leaf, before[name]) == (i == 1), name


def test_heads():
    n_rows, sizes, strip = 300, heads.Sizes(11, 2, 5, 264), CORES.constants["STRIP"]
    first_score, _, n_columns = sizes.starts
    columns, target = randn(n_rows, n_columns).to(BF16), randn(n_rows, first_score).to(BF16)
    actions = torch.randint(5, (P, n_rows, 2), device="cuda")
    values = heads.Value(randn(1, 264), randn(1), randn(), randn())
    results, gradients = torch.randn(2, 4, P, n_rows, device="cuda")
    names, n_strips = ("logprobs", "entropies", "errors", "values"), -(-n_rows // strip)
    inputs = dict(product=columns, target=target, actions=actions)
    weights = {f"value_{name}": leaf for name, leaf in values._asdict().items()}
    launch(
        *(CORES, "heads_forward", (n_strips, P), CORES.constants["STRIP_THREADS"]),
        **inputs,
        **weights,
        **dict(zip(names, results)),
        n_rows=n_rows,
        **sizes._asdict(),
    )
    d_columns, sums = torch.empty_like(columns), randn(n_strips, n_columns + 264 + 8)
    launch(
        *(CORES, "heads_backward", (3 * n_strips, P), CORES.constants["STRIP_THREADS"]),
        **inputs,
        value_weight=values.weight,
        value_scale=values.scale,
        **{f"d_{name}": d for name, d in zip(names, gradients)},
        d_product=d_columns,
        sums=sums,
        n_rows=n_rows,
        **sizes._asdict(),
    )
    for i in range(P):
        of_policy = columns[i], target[i], actions[i], heads.Value(*(leaf[i] for leaf in values))
        for name, one, other in zip(names, results, heads.forward(*of_policy, sizes)):
            assert torch.equal(one[i], other), name
        alone = heads.backward(*of_policy, sizes, tuple(gradients[:, i].contiguous()))
        assert torch.equal(d_columns[i], alone[0]), i
        expected = torch.cat([leaf.flatten() for leaf in alone[1:]])
        torch.testing.assert_close(sums[i].sum(0)[: len(expected)], expected)


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
    batch["n_valid"] = batch.valid.sum((1, 2))
    launch(
        *(ALGORITHMS, "ppo_loss", (n_blocks(n_rows), P)),
        **inputs,
        old_logprobs=batch.logprobs,
        old_values=batch.old_value,
        advantages=batch.advantages,
        targets=batch.targets,
        valid=batch.valid,
        n_valid=batch.n_valid,
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
        means = torch.stack([*metrics.values(), loss.detach()])
        torch.testing.assert_close(sums[i].sum(0), means)
