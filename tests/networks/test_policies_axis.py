"""Kernels with weights or statistics take several policies: each gets what it gets alone."""

import pytest
import torch

from megastep.agents.algorithms.adam import Adam
from megastep.agents.algorithms.kernels import PROGRAM as ALGORITHMS
from megastep.agents.algorithms.ppo_loss import Coefficients, ppo_loss
from megastep.agents.networks.kernels import (
    conv,
    duelling,
    heads,
    layers,
    mingru_step,
    moments,
)
from megastep.agents.networks.kernels.program import CORES
from megastep.agents.networks.running_norm import RunningNorm
from megastep.agents.networks.value_output import ValueOutput
from megastep.arrdict import arrdict
from megastep.kernels.build.launch import BLOCK, WARP, Blocks, launch
from megastep.spaces import MultiVector

pytestmark = pytest.mark.cuda
P = 3
BF16 = torch.bfloat16
GPU = torch.device("cuda")


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
            values=leaf,
            mean=mean,
            scale=scale,
            n_features=leaf.shape[-1],
            group=leaf.shape[-1] // mean.shape[-1],
            is_half=int(leaf.dtype == torch.float16),
        )
        for leaf, mean, scale in zip(leaves, means, scales, strict=True)
    ]
    n_threads = n_columns // 4 * -(-7 // CORES.constants["NORMALISED_ROWS"])
    launch(
        *(CORES, "normalise", GPU, Blocks(-(-n_threads // BLOCK), P * n_steps)),
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
        alone = layers.normalise(*of_policy, n_columns, lanes[i])
        assert torch.equal(features[i], alone), i


@pytest.mark.parametrize("shape", [(3, 128), (5, 37)])
def test_convolutions(shape):
    n_rows, n_features = 100, conv.CHANNELS * conv.n_outputs(shape[1])
    rows = randn(n_rows, *shape).to(BF16)
    if not conv.is_supported(rows[0]):
        pytest.skip("needs a GPU with clusters")
    weights = dict(
        first_weight=randn(32, shape[0], 8).to(BF16),
        first_bias=randn(32).to(BF16),
        second_weight=randn(32, 32, 4).to(BF16),
        second_bias=randn(32).to(BF16),
    )
    features = torch.full((P, n_rows, n_features), torch.nan, dtype=BF16, device="cuda")
    kernel, blocks, sizes = conv.forward_kernel(*shape, 2, P)
    launch(
        *(conv.PROGRAM, kernel, GPU, blocks),
        rows=rows,
        **weights,
        features=features,
        n_rows=n_rows,
        n_channels=shape[0],
        n_columns=shape[1],
        row_stride=shape[0] * shape[1],
        feature_stride=n_features,
        **sizes,
    )
    for i in range(P):
        alone = conv.conv_forward(rows[i], *(weight[i] for weight in weights.values()))
        assert torch.equal(features[i], alone), i


@pytest.mark.parametrize("n_lanes, width", [(37, 256), (300, 64)])
def test_mingru_step(n_lanes, width):
    x, start = randn(n_lanes, width).to(BF16), randn(n_lanes, width)
    if not mingru_step.is_supported(x[:1]):
        pytest.skip("needs a GPU with clusters")
    inputs = dict(
        x=x,
        weight=(randn(2 * width, width) / width**0.5).to(BF16),
        bias=randn(2 * width).to(BF16),
        reset=randn(n_lanes) < 0,
        start=start,
    )
    results = dict(outputs=torch.full_like(x, torch.nan), last=torch.full_like(start, torch.nan))
    where = mingru_step.PROGRAM, f"mingru_step_{width}", GPU, mingru_step.blocks(n_lanes, width, P)
    launch(*where, **inputs, **results, n_lanes=n_lanes, is_residual=1)
    for i in range(P):
        of_policy = {name: leaf[i] for name, leaf in inputs.items()}
        of_policy |= {name: of_policy[name][None] for name in ("x", "reset")}
        outputs, last = mingru_step.forward(**of_policy, is_residual=True)
        assert torch.equal(results["outputs"][i], outputs[0]), i
        assert torch.equal(results["last"][i], last), i


def test_statistics_of_observations():
    """One policy counts no lane, and another's numbers of one leaf are not finite."""
    n_lanes, sizes, threads = 50, (4, 5), CORES.constants["MOMENTS_THREADS"]
    leaves = [randn(n_lanes, 16).half(), randn(n_lanes, 5)]
    leaves[1][2, 7, 3] = torch.nan
    is_counted = torch.rand(P, n_lanes, device="cuda") < 0.7
    is_counted[1], is_counted[2, 7] = False, True
    results = [randn(2, n).transpose(0, 1).contiguous() for n in sizes]  # (2, P, n)
    results = torch.cat([result.flatten() for result in results])
    n_counted = torch.empty(P, dtype=torch.int64, device="cuda")
    packed = [
        CORES.params.IntakeLeafParams(
            values=leaf,
            mean=None,
            scale=None,
            n_features=leaf.shape[-1],
            group=leaf.shape[-1] // n,
            is_half=int(leaf.dtype == torch.float16),
        )
        for leaf, n in zip(leaves, sizes, strict=True)
    ]
    launch(
        *(CORES, "moments", GPU, Blocks(sum(sizes), P, threads)),
        leaves=b"".join(packed),
        is_counted=is_counted,
        moments=results,
        n_counted=n_counted,
        n_lanes=n_lanes,
    )
    of_leaves = [
        part.view(2, P, n) for part, n in zip(results.split([2 * P * n for n in sizes]), sizes)
    ]
    means, scales = [randn(n) for n in sizes], [randn(n).abs() + 0.1 for n in sizes]
    counts = torch.tensor([[1.0, 2.0, 3.0]] * 2, device="cuda")
    norms = [[RunningNorm(MultiVector(1, n)).cuda() for n in sizes] for _ in range(P)]
    for i in range(P):
        for norm, mean, scale, count in zip(norms[i], means, scales, counts, strict=True):
            norm.mean.copy_(mean[i, None])
            norm.scale.copy_(scale[i, None])
            norm.count.copy_(count[i])
    packed = [
        CORES.params.RunningNormParams(
            mean=mean,
            scale=scale,
            count=count,
            new_mean=new_mean,
            new_variance=new_variance,
            n_counted=n_counted,
            n=n,
            min_scale=norms[0][0].min_scale,
        )
        for n, mean, scale, count, (new_mean, new_variance) in zip(
            sizes, means, scales, counts, of_leaves, strict=True
        )
    ]
    are_added = torch.tensor([False, True, True], device="cuda")
    for flags in (None, are_added):
        launch(
            *(CORES, "add_moments", GPU, Blocks(len(sizes), P, threads)),
            norms=b"".join(packed),
            is_counted=flags,
        )
    assert counts.tolist() == [[2, 2, 5], [2, 2, 3]]
    for i in range(P):
        n, *alone = moments.moments([leaf[i] for leaf in leaves], list(sizes), is_counted[i])
        assert n_counted[i] == n
        for result, mean, variance in zip(of_leaves, *alone, strict=True):
            for one, other in zip(result[:, i], (mean, variance), strict=True):
                torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)
        for flag in (None, are_added[i]):
            moments.add_moments(norms[i], [(n, *pair) for pair in zip(*alone, strict=True)], flag)
        for norm, mean, scale, count in zip(norms[i], means, scales, counts, strict=True):
            assert torch.equal(norm.mean[0], mean[i]) and torch.equal(norm.scale[0], scale[i])
            assert norm.count == count[i]


def test_statistics_of_returns():
    """Policies have different valid returns; one does not count its own."""
    n, width, threads = 5000, 40, CORES.constants["MASKED_THREADS"]
    arrays = [randn(n), 3 * randn(n) + 1]
    valid = torch.rand(P, n, device="cuda") < 0.6
    n_parts = -(-n // (threads * CORES.constants["MASKED_NUMBERS"]))
    parts, results = randn(len(arrays), n_parts, 3), randn(len(arrays), 2)
    n_valid = torch.empty(P, dtype=torch.int64, device="cuda")
    pack = CORES.params.MaskedArrayParams
    shared = dict(parts=parts, n_arrays=len(arrays))
    launch(
        *(CORES, "masked_parts", GPU, Blocks(n_parts, P * len(arrays), threads)),
        arrays=b"".join(pack(values=array) for array in arrays),
        valid=valid,
        n=n,
        **shared,
    )
    launch(
        *(CORES, "masked_moments", GPU, Blocks(1, P * len(arrays), threads)),
        **shared,
        moments=results,
        n_valid=n_valid,
        n_parts=n_parts,
    )
    means, variances = (column.contiguous() for column in results[:, 1].unbind(1))
    normalised = torch.empty_like(arrays[1])
    launch(
        *(CORES, "normalise_masked", GPU, Blocks(-(-n // BLOCK), P)),
        values=arrays[1],
        valid=valid,
        mean=means,
        variance=variances,
        normalised=normalised,
        n=n,
    )
    outputs = [ValueOutput(width).cuda() for _ in range(P)]
    is_counted = torch.tensor([True, False, True], device="cuda")
    names = "weight", "bias", "mean", "scale", "count"
    of_all = {
        name: torch.stack(
            [
                (output.state_dict() | dict(output.linear.named_parameters()))[name]
                for output in outputs
            ]
        ).detach()
        for name in names
    }
    launch(
        *(CORES, "add_returns", GPU, Blocks(1, P, threads)),
        **of_all,
        new_mean=means,
        new_variance=variances,
        n_valid=n_valid,
        is_counted=is_counted,
        width=width,
        min_rate=0.05,
        min_scale=outputs[0].min_scale,
    )
    for i in range(P):
        count, alone = moments.masked_moments([array[i] for array in arrays], valid[i])
        assert n_valid[i] == count and torch.equal(results[i], alone)
        one = moments.normalise_masked(arrays[1][i], valid[i], *alone[1])
        assert torch.equal(normalised[i], one)
        outputs[i].add((count, *alone[1]), is_counted[i])
        state = outputs[i].state_dict() | dict(outputs[i].linear.named_parameters())
        for name, tensor in of_all.items():
            assert torch.equal(tensor[i], state[name]), name
    assert of_all["count"].tolist() == [1, 0, 1]


@pytest.mark.parametrize("n_columns", [8, 264])  # 264: two blocks of columns
def test_bias_gradient(n_columns):
    n_rows, strip = 300, CORES.constants["STRIP"]
    n_strips = -(-n_rows // strip)
    d, activated = randn(n_rows, n_columns).to(BF16), randn(n_rows, n_columns).to(BF16).relu()
    d_masked, sums = torch.empty_like(d), randn(n_strips, n_columns)
    n_parts, n_threads = -(-n_columns // (8 * WARP)), CORES.constants["STRIP_THREADS"]
    launch(
        *(CORES, "bias_gradient", GPU, Blocks(n_strips, P * n_parts, n_threads)),
        d=d,
        activated=activated,
        d_masked=d_masked,
        sums=sums,
        n_rows=n_rows,
        n_columns=n_columns,
        d_stride=n_columns,
        n_strips=n_strips,
    )
    for i in range(P):
        masked, total = layers.bias_gradient(d[i], activated[i])
        assert torch.equal(d_masked[i], masked), i
        torch.testing.assert_close(sums[i].sum(0), total)


def test_casts():
    """Numbers after a weight are zeros, of each policy."""
    weights, threads = [randn(3), randn(77, 5), randn(70_000)], CORES.constants["CAST_THREADS"]
    sizes, rows, n = [8, 400, 70_000], [], 0
    targets = [torch.full((P, size), torch.nan, dtype=BF16, device="cuda") for size in sizes]
    for weight, target, size in zip(weights, targets, sizes, strict=True):
        rows.append(
            CORES.params.CastRowParams(
                source=weight,
                target=target,
                n=weight[0].numel(),
                n_padded=size,
                first_block=n,
            )
        )
        n += -(-size // (8 * threads))
    launch(CORES, "cast", GPU, Blocks(n, P, threads), rows=b"".join(rows), n_rows=len(rows))
    for weight, target in zip(weights, targets, strict=True):
        rounded = weight.flatten(1).to(BF16)
        assert torch.equal(target[:, : rounded.shape[1]], rounded)
        assert not target[:, rounded.shape[1] :].any()


def test_categorical_actions():
    n_lanes, width, shape = 37, 64, (2, 5)
    features, noise = randn(n_lanes, width).to(BF16), randn(n_lanes, *shape).abs()
    weight, bias = randn(10, width).to(BF16), randn(10).to(BF16)
    logits, logprobs = randn(n_lanes, *shape), randn(n_lanes)
    actions = torch.empty(P, n_lanes, shape[0], dtype=torch.int64, device="cuda")
    n_threads = CORES.constants["ACT_THREADS"] * n_lanes
    launch(
        *(CORES, "categorical_act_bfloat16", GPU, Blocks(-(-n_threads // BLOCK), P)),
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
        *(CORES, "heads_forward", GPU, Blocks(n_strips, P, CORES.constants["STRIP_THREADS"])),
        **inputs,
        **weights,
        **dict(zip(names, results)),
        n_rows=n_rows,
        **sizes._asdict(),
    )
    d_columns, sums = torch.empty_like(columns), randn(n_strips, n_columns + 264 + 8)
    launch(
        *(CORES, "heads_backward", GPU, Blocks(3 * n_strips, P, CORES.constants["STRIP_THREADS"])),
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
    n_steps = torch.tensor([2.0, 7.0, 1.0], device="cuda")
    is_taken = torch.tensor([True, True, False], device="cuda")
    alone, norms = [], []
    for i in range(P):
        params = [torch.nn.Parameter(weight[i].clone()) for weight in weights]
        adam = Adam(params, lr[i].clone(), weight_decays={params[0]: 0.1})
        adam.n_steps.fill_(n_steps[i])
        for kept, values in zip((adam.means, adam.squares), moments, strict=True):
            for target, value in zip(kept, values, strict=True):
                target.copy_(value[i])
        for param, gradient in zip(params, gradients, strict=True):
            param.grad = gradient[i].clone()
        norms.append(adam.grad_norm())
        adam.step(is_taken[i].clone(), norms[-1], max_norm)
        alone.append([*(p.detach() for p in params), *adam.means, *adam.squares])

    rows, n, n_threads = [], 0, ALGORITHMS.constants["ADAM_THREADS"]
    for at, row in enumerate(zip(weights, gradients, *moments, strict=True)):
        names = "parameter", "gradient", "mean", "square"
        rows.append(
            ALGORITHMS.params.AdamRowParams(
                **dict(zip(names, row, strict=True)),
                n=row[0][0].numel(),
                first_block=n,
                is_aligned=1,
                lr_factor=1.0,
                weight_decay=0.0 if at else 0.1,
            )
        )
        n += -(-row[0][0].numel() // (4 * n_threads))
    packed, sums = dict(rows=b"".join(rows), n_rows=len(rows)), randn(n)
    launch(
        *(ALGORITHMS, "squared_norm", GPU, Blocks(n, P, n_threads)),
        **packed,
        sums=sums,
        n_sums=n,
        first_sum=0,
    )
    judged = dict(grad_norm=randn(), is_taken=torch.empty_like(is_taken), totals=randn(4))
    launch(
        *(ALGORITHMS, "judge", GPU, Blocks(1, P, n_threads)),
        metrics=ALGORITHMS.params.MetricParams(values=lr),
        sums=sums,
        is_finite=torch.tensor([True, True, False], device="cuda"),
        is_enabled=torch.ones_like(is_taken),
        n_valid=torch.tensor([4, 1, 4], device="cuda"),
        n_steps=n_steps,
        **judged,
        n_sums=n,
        n_metrics=1,
        is_first=1,
    )
    torch.testing.assert_close(judged["grad_norm"], torch.stack(norms))
    assert torch.equal(judged["is_taken"], is_taken) and n_steps.tolist() == [3, 8, 1]
    expected = torch.stack([lr, torch.stack(norms), torch.ones_like(lr), torch.zeros_like(lr)], 1)
    expected[2] = torch.tensor([0, 0, 0, 1])
    torch.testing.assert_close(judged["totals"], expected)
    launch(
        *(ALGORITHMS, "adam", GPU, Blocks(n, P, n_threads)),
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
    sums = randn(-(-n_rows // BLOCK), ALGORITHMS.constants["N_SUMS"])
    batch["n_valid"] = batch.valid.sum((1, 2))
    launch(
        *(ALGORITHMS, "ppo_loss", GPU, Blocks(-(-n_rows // BLOCK), P)),
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
        *(CORES, "duelling_act", GPU, Blocks(-(-n_rows // 8), P)),
        **dict(zip(names, weights, strict=True)),
        **dict(hidden=hidden, noise=noise, epsilon=epsilon, values=values),
        **dict(actions=actions, logprobs=logprobs, n_rows=n_rows, width=width),
        **dict(n_agents=2, n_choices=3, usual_epsilon=0.05),
    )
    d_values, d_hidden = randn(n_rows, *shape), torch.empty_like(hidden)
    sums = randn(1, (2 + 2 + 6) * width + 8)
    launch(
        *(CORES, "duelling_backward", GPU, Blocks(1, P, CORES.constants["DUELLING_THREADS"])),
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
