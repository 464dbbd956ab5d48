"""The fused forms of layers on a GPU against their plain forms in float32."""

import pytest
import torch
from torch import nn

from megastep import spaces
from megastep.agents.networks import encoders, heads, intakes, layers
from megastep.agents.networks.kernels import casts
from megastep.agents.networks.kernels import layers as kernel_layers
from megastep.agents.networks.kernels.library import aligned_rows
from megastep.agents.networks.precision import ComputeDtype, cast, cast_joined, once
from megastep.arrdict import arrdict

BF16 = dict(rtol=0, atol=2e-2)  # times the largest number: 8 bits, and sums of them


def assert_close(fused, plain, **tolerance):
    scale = plain.abs().max().item() or 1.0
    tolerance = {**BF16, **tolerance}
    tolerance["atol"] *= scale
    torch.testing.assert_close(fused.float().cpu(), plain.float().cpu(), **tolerance)


def test_weights_are_cast_once_per_context():
    weight = nn.Parameter(torch.randn(7, 3))
    assert cast(weight, torch.bfloat16) is not cast(weight, torch.bfloat16)
    with ComputeDtype("cpu", torch.bfloat16), ComputeDtype("cpu", torch.bfloat16):
        first = cast(weight, torch.bfloat16)
        assert cast(weight, torch.bfloat16) is first
    assert torch.equal(first, weight.bfloat16()) and not first.requires_grad
    with torch.no_grad():
        weight.add_(1.0)
    with ComputeDtype("cpu", torch.bfloat16):
        assert torch.equal(cast(weight, torch.bfloat16), weight.bfloat16())
        padded = cast(weight, torch.bfloat16, multiple=8)
    assert padded.shape == (8, 3) and not padded[7].any()


def test_weights_are_joined_once_per_context():
    weights = nn.Parameter(torch.randn(7, 3)), nn.Parameter(torch.randn(7, 2))
    expected = torch.cat(weights, 1).detach()
    assert torch.equal(cast_joined(weights, torch.float32), expected)
    with ComputeDtype("cpu", torch.bfloat16):
        joined = cast_joined(weights, torch.bfloat16)
        assert cast_joined(weights, torch.bfloat16) is joined
    assert torch.equal(joined, expected.bfloat16()) and not joined.requires_grad


def test_what_follows_from_weights_is_made_once_per_context():
    conv = encoders.BandedConv1d(3, 16, 2, kernel_size=4, stride=2, padding=1)
    rows = torch.randn(5, 3, 16)
    with ComputeDtype("cpu", torch.bfloat16, enabled=False), torch.no_grad():
        with ComputeDtype("cpu", torch.bfloat16, enabled=False):
            torch.testing.assert_close(conv.as_product(rows), conv(rows))
        matrix = once((conv.weight,), "matrix", conv.matrix)
        assert once((conv.weight,), "matrix", conv.matrix) is matrix
        with torch.enable_grad():
            gradient = torch.autograd.grad(conv.as_product(rows).sum(), conv.weight)[0]
    assert gradient.any()
    with torch.no_grad():
        conv.weight.mul_(2.0)
        with ComputeDtype("cpu", torch.bfloat16, enabled=False):
            torch.testing.assert_close(conv.as_product(rows), conv(rows))


@pytest.mark.cuda
def test_weights_of_inner_contexts_are_cast_together():
    weights = [torch.randn(3, 8, device="cuda") for _ in range(4)]
    halves = weights[:2], weights[2:]
    with ComputeDtype("cuda", torch.bfloat16, weights=lambda: halves[0]):
        for half in (*halves, *halves):
            with ComputeDtype("cuda", torch.bfloat16, weights=lambda half=half: half):
                first, second = (cast(weight, torch.bfloat16) for weight in half)
                assert second.data_ptr() - first.data_ptr() == 128  # neighbours, padded to 8 rows
        outer = cast(weights[0], torch.bfloat16)
        assert torch.equal(outer, weights[0].bfloat16())


@pytest.mark.cuda
def test_weights_of_a_context_are_cast_together():
    """More than fit into a launch, some misaligned or not contiguous, and one of no context."""
    torch.manual_seed(0)
    shapes = [*((n,) for n in range(1, 50)), (7, 3), (1, 256), (1024, 264), ()]
    weights = [nn.Parameter(torch.randn(shape, device="cuda")) for shape in shapes]
    weights.append(torch.randn(41, device="cuda")[1:].view(4, 10))
    weights += [torch.randn(6, 4, device="cuda").T, torch.randn(5, device="cuda").double()]
    weights[3].data[0] = torch.nan
    other = torch.randn(9, 2, device="cuda")
    for _ in range(2):
        with ComputeDtype("cuda", torch.bfloat16, weights=lambda: weights):
            for weight in (w for w in (*weights, other) if w.dim()):
                rounded = cast(weight, torch.bfloat16)
                expected = weight.detach().bfloat16()
                torch.testing.assert_close(rounded, expected, rtol=0, atol=0, equal_nan=True)
                assert cast(weight, torch.bfloat16) is rounded and not rounded.requires_grad
                padded = cast(weight, torch.bfloat16, multiple=8)
                assert len(padded) % 8 == 0 and not padded[len(weight) :].any()
                torch.testing.assert_close(
                    padded[: len(weight)], expected, rtol=0, atol=0, equal_nan=True
                )
        with torch.no_grad():
            weights[10].add_(1.0)


def test_weights_are_rounded_as_by_pytorch(to_gpu):
    """More than fit into a launch; some fill several blocks, others no vector of eight."""
    torch.manual_seed(0)
    shapes = [*((n,) for n in range(1, 50)), (7, 3), (1, 256), (100, 264), (33, 8, 2)]
    weights = [torch.randn(shape) for shape in shapes]
    weights[3][0], weights[4][1] = torch.nan, torch.inf
    for weight, ours in zip(weights, casts.cast([*map(to_gpu, weights)], 8), strict=True):
        assert len(ours) == -(-len(weight) // 8) * 8 and not ours[len(weight) :].any()
        expected = weight.bfloat16()
        torch.testing.assert_close(
            ours[: len(weight)].cpu(), expected, rtol=0, atol=0, equal_nan=True
        )


@pytest.mark.parametrize("lanes", [None, [3, 0, 3, 4]])
@pytest.mark.parametrize("kinds", [(48, 3, 12), (12, 5), (7,), (3, 64, 1)])
def test_normalised_observations_are_those_of_the_plain_form(to_gpu, kinds, lanes):
    """Leaves of 1 to 64 features in float16 and float32, with statistics of one or more."""
    torch.manual_seed(0)
    leaves, means, scales, expected = [], [], [], []
    for i, n_features in enumerate(kinds):
        leaf = torch.randn(3, 5, n_features).to(torch.float32 if i % 2 else torch.float16)
        n_groups = 3 if n_features % 3 == 0 else 1
        mean, scale = torch.randn(n_groups), torch.rand(n_groups) + 0.5
        group = n_features // n_groups
        numbers = (leaf - mean.repeat_interleave(group)) / scale.repeat_interleave(group)
        expected.append(numbers if lanes is None else numbers[:, lanes])
        for moved, tensor in zip((leaves, means, scales), (leaf, mean, scale), strict=True):
            moved.append(to_gpu(tensor))
    n_columns = -(-sum(kinds) // 8) * 8 + 8
    of = None if lanes is None else to_gpu(torch.tensor(lanes))
    features = kernel_layers.normalise(leaves, means, scales, n_columns, of).cpu()
    # a product with 1 / scale may differ in the last bit of float32, and so of bfloat16
    torch.testing.assert_close(
        features[..., : sum(kinds)], torch.cat(expected, -1).bfloat16(), rtol=2**-7, atol=1e-6
    )
    assert features.shape[-1] == n_columns and not features[..., sum(kinds) :].any()


@pytest.mark.cuda
@pytest.mark.parametrize("activation", [None, torch.relu])
@pytest.mark.parametrize(
    "n_rows, n_in, n_out", [(1, 8, 1), (100, 64, 7), (999, 264, 256), (3, 8, 52)]
)
def test_linear_matches_float32(activation, n_rows, n_in, n_out):
    torch.manual_seed(0)
    layer = nn.Linear(n_in, n_out).cuda()
    x = torch.randn(2, n_rows, n_in, device="cuda").bfloat16().float().requires_grad_()
    d = torch.randn(2, n_rows, n_out, device="cuda").bfloat16().float()
    results = []
    for is_fused in (True, False):
        with torch.autocast("cuda", torch.bfloat16, enabled=is_fused):
            y = layers.linear(x, layer, activation)
        assert y.dtype == (torch.bfloat16 if is_fused else torch.float32)
        assert ("_Linear" in type(y.grad_fn).__name__) == is_fused
        # a unit near 0 may be on either side of the ReLU's kink
        kept = (y.abs() > 0.05) if activation else torch.ones_like(y, dtype=torch.bool)
        results.append((y.detach(), kept))
    is_kept = results[0][1] & results[1][1]
    gradients = []
    for is_fused in (True, False):
        with torch.autocast("cuda", torch.bfloat16, enabled=is_fused):
            y = layers.linear(x, layer, activation)
        loss = (y * d.to(y.dtype) * is_kept).float().sum()
        gradients.append(torch.autograd.grad(loss, [x, *layer.parameters()]))
    assert_close(results[0][0], results[1][0])
    for fused, plain in zip(*gradients, strict=True):
        assert fused.dtype == torch.float32
        assert_close(fused, plain)


@pytest.mark.cuda
@pytest.mark.parametrize("n_out", [7, 16])
@pytest.mark.parametrize("frozen", ["weight", "bias", "both", "input"])
def test_frozen_layers_pass_gradients(n_out, frozen):
    torch.manual_seed(0)
    layer = nn.Linear(16, n_out).cuda()
    x = torch.randn(5, 16, device="cuda", requires_grad=frozen != "input")
    layer.weight.requires_grad_(frozen not in ("weight", "both"))
    layer.bias.requires_grad_(frozen not in ("bias", "both"))
    leaves = [leaf for leaf in (x, *layer.parameters()) if leaf.requires_grad]
    gradients = []
    for is_fused in (True, False):
        with torch.autocast("cuda", torch.bfloat16, enabled=is_fused):
            y = layers.linear(x, layer)
        gradients.append(torch.autograd.grad(y.float().square().sum(), leaves))
    for fused, plain in zip(*gradients, strict=True):
        assert_close(fused, plain)


def test_rows_are_copied_only_if_they_are_misaligned():
    matrix = torch.arange(320.0).view(10, 32)
    for part in (matrix, matrix[:, 4:12], matrix[2:, 8:9]):
        assert aligned_rows(part) is part
    odd = torch.arange(70.0).view(10, 7)
    parts = matrix[:, 3:11], matrix.T, odd[:, :4], matrix[:1, 4:].expand(3, -1), odd[1:2]
    for part in parts:
        copied = aligned_rows(part)
        assert torch.equal(copied, part) and copied.is_contiguous() and not copied.data_ptr() % 16


@pytest.mark.cuda
def test_gradient_of_one_row_may_begin_anywhere():
    """One row of a wider tensor counts as contiguous, wherever it begins."""
    layer = nn.Linear(8, 8).cuda()
    x = torch.randn(1, 8, device="cuda")
    gradients = []
    for is_fused in (True, False):
        with torch.autocast("cuda", torch.bfloat16, enabled=is_fused):
            y = layers.linear(x, layer)
            joined = torch.cat([y.new_zeros(1, 3), y], 1)
        d = torch.arange(11.0, device="cuda", dtype=joined.dtype)[None]
        gradients.append(torch.autograd.grad(joined, layer.bias, d)[0])
    assert torch.equal(gradients[0], gradients[1])


def test_nan_passes_the_gradient_of_a_relu(to_gpu):
    d = to_gpu(torch.randn(3, 8).bfloat16())
    y = to_gpu(torch.tensor([torch.nan, 1.0, 0.0]).bfloat16()[:, None].expand(3, 8))
    masked, _ = layers.kernels.bias_gradient(d, y.contiguous())
    assert torch.equal(masked, torch.ops.aten.threshold_backward(d, y, 0))
    assert torch.equal(masked[0], d[0]) and not masked[2].any()


@pytest.mark.parametrize("n_rows", [1, 31, 256, 300, 4096, 100_001])
@pytest.mark.parametrize("n_columns", [8, 56, 256, 264, 1024])
def test_bias_gradient_is_the_sum_of_rows_and_repeatable(to_gpu, n_rows, n_columns):
    if n_rows > 1000 and to_gpu is not torch.Tensor.cuda:
        pytest.skip("takes long on a CPU")
    torch.manual_seed(0)
    d = to_gpu(torch.randn(n_rows, n_columns).bfloat16())
    y = torch.randn_like(d).relu()
    masked, sums = layers.kernels.bias_gradient(d, y)
    assert torch.equal(masked, d.masked_fill(y <= 0, 0.0))
    expected = masked.double().sum(0).float()
    torch.testing.assert_close(sums, expected, rtol=1e-4, atol=1e-5 * n_rows**0.5 + 1e-3)
    assert torch.equal(layers.kernels.bias_gradient(d, y)[1], sums)
    wide = to_gpu(torch.randn(n_rows, n_columns + 16).bfloat16())
    wide[:, 8:-8] = d
    ours = layers.kernels.bias_gradient(aligned_rows(wide[:, 8:-8]), y)
    assert torch.equal(ours[0], masked) and torch.equal(ours[1], sums)
    same, sums = layers.kernels.bias_gradient(d)
    assert same is d
    expected = d.double().sum(0).float()
    torch.testing.assert_close(sums, expected, rtol=1e-4, atol=1e-5 * n_rows**0.5 + 1e-3)


@pytest.mark.cuda
@pytest.mark.parametrize("cameras", [1, 3])
@pytest.mark.parametrize("lead", [(5,), (3, 40)])
def test_intake_matches_the_plain_form(cameras, lead):
    torch.manual_seed(0)
    space = arrdict(
        rgb=spaces.MultiImage(1, 3, cameras, 16),
        near=spaces.MultiVector(2, 3),
        imu=spaces.MultiVector(1, 3),
    )
    intake = heads.intake(space, 32).cuda()
    for norm in intake.norms:
        norm.mean.normal_()
        norm.scale.uniform_(0.1, 2.0)
    obs = arrdict(
        rgb=torch.rand(*lead, 1, 3, cameras, 16, device="cuda").half(),
        near=torch.randn(*lead, 2, 3, device="cuda"),
        imu=torch.randn(*lead, 1, 3, device="cuda").half(),
    )
    lanes = torch.tensor([3, 0, 3], device="cuda") if len(lead) == 2 else None
    with torch.autocast("cuda", torch.bfloat16):
        fused = intake.encode(obs, lanes)
        intake.is_fused = False
        plain = intake.encode(obs, lanes)
    assert fused.dtype == torch.bfloat16
    # a product with 1 / scale may differ in the last bit of float32, and so of bfloat16
    torch.testing.assert_close(fused, plain, rtol=2**-7, atol=1e-6)
    assert (fused == plain).float().mean() > 0.999


IMAGE, VECTOR = spaces.MultiImage(1, 3, 1, 16), spaces.MultiVector(1, 3)
MIXED_SPACES = [
    dict(rgb=IMAGE, d=spaces.MultiImage(1, 1, 1, 16), imu=VECTOR, health=VECTOR),
    dict(imu=VECTOR, rgb=spaces.MultiImage(2, 3, 1, 16), health=VECTOR, far=IMAGE),
    dict(rgb=IMAGE),
    dict(imu=VECTOR, near=spaces.MultiVector(2, 4)),
]


def mixed_intake(space, lead, device, encoder="conv"):
    """Returns an intake with statistics, and observations."""
    torch.manual_seed(0)
    intake = heads.intake(arrdict(space), 32, encoder)
    for norm in intake.norms:
        norm.mean.normal_()
        norm.scale.uniform_(0.5, 2.0)
    obs = arrdict({key: torch.randn(*lead, *leaf.shape).half() for key, leaf in space.items()})
    return intake.to(device), obs.map(lambda leaf: leaf.to(device))


@pytest.mark.parametrize("encoder", ["linear", "conv", "cnn"])
@pytest.mark.parametrize("space", MIXED_SPACES)
def test_encoders_read_parts_of_wider_rows(space, encoder, monkeypatch):
    intake, obs = mixed_intake(space, (3, 5), "cpu", encoder)
    plain = intake.encode(obs)

    def side_by_side(leaves, norms, n_columns, lanes):
        parts = [norm(leaf).flatten(2) for leaf, norm in zip(leaves, norms, strict=True)]
        n_zeros = n_columns - sum(part.shape[-1] for part in parts)
        assert n_columns % 8 == 0 and n_zeros >= intake.n_padding
        return torch.cat([*parts, torch.zeros(3, 5, n_zeros)], -1)

    monkeypatch.setattr(intakes, "normalised", side_by_side)
    torch.testing.assert_close(intake.encode(obs), plain)


@pytest.mark.cuda
@pytest.mark.parametrize("space", MIXED_SPACES)
@pytest.mark.parametrize("lead", [(5,), (3, 40)])
def test_convolutions_of_an_intake_match_the_plain_form(space, lead):
    intake, obs = mixed_intake(space, lead, "cuda")
    lanes = torch.tensor([3, 0, 3], device="cuda") if len(lead) == 2 else None
    results = []
    for is_fused in (True, False):
        intake.is_fused = is_fused
        with ComputeDtype("cuda", torch.bfloat16):
            features = intake(obs, lanes)
            with torch.no_grad():
                for _ in range(2):  # the second time with what the context remembers
                    assert_close(intake(obs, lanes), features.detach())
        weights = torch.randn(features.shape, generator=torch.Generator().manual_seed(1))
        loss = (features.float() * weights.cuda()).sum()
        results.append([features.detach(), *torch.autograd.grad(loss, [*intake.parameters()])])
    for fused, plain in zip(*results, strict=True):
        assert fused.dtype == plain.dtype
        error = (fused.float() - plain.float()).norm() / plain.float().norm()
        assert error < 0.1, error  # 8 bits, and ReLUs near their kink


@pytest.mark.cuda
@pytest.mark.parametrize("bf16", [False, True])
@pytest.mark.parametrize("shape", [(1, 7), (3, 2), (1, 8), (1, 32)])
def test_acting_matches_the_plain_form(bf16, shape):
    torch.manual_seed(0)
    output = heads.output(spaces.MultiDiscrete(*shape), 256).cuda()
    nn.init.normal_(output.linear.weight, std=0.1)
    x = torch.randn(1000, 256, device="cuda").bfloat16().float()
    for sample in (True, False):
        generators = [torch.Generator("cuda").manual_seed(3) for _ in range(2)]
        with torch.autocast("cuda", torch.bfloat16, enabled=bf16), torch.no_grad():
            fused = output.act(x, sample, generators[0])
            plain = super(type(output), output).act(x, sample, generators[1])
        torch.testing.assert_close(fused[0], plain[0], rtol=0, atol=6e-2 if bf16 else 1e-2)
        same = (fused[1] == plain[1]).all(-1)
        assert same.float().mean() > (0.97 if bf16 else 0.995)
        torch.testing.assert_close(fused[2], output.logprob(fused[0], fused[1]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("n_lanes, shape", [(1, (1, 7)), (37, (3, 2)), (70, (1, 8))])
def test_actions_are_those_of_the_plain_form(to_gpu, n_lanes, shape, dtype):
    torch.manual_seed(0)
    n_scores = shape[0] * shape[1]
    x, weight, bias = torch.randn(n_lanes, 64), torch.randn(n_scores, 64), torch.randn(n_scores)
    x, weight, bias = (to_gpu(leaf.to(dtype)) for leaf in (x, 0.1 * weight, bias))
    scores = nn.functional.linear(x.double(), weight.double(), bias.double()).to(dtype)
    expected = scores.double().unflatten(-1, shape).log_softmax(-1).float()
    noise = to_gpu(torch.empty(n_lanes, *shape).exponential_())
    for noise_or_none in (None, noise):
        logits, actions, logprobs = layers.kernels.act(x, weight, bias, shape, noise_or_none)
        slack = 3e-2 if dtype == torch.bfloat16 else 1e-5  # a score may round to the next number
        torch.testing.assert_close(logits, expected, rtol=0, atol=slack)
        values = logits if noise_or_none is None else logits - noise.log()
        chosen = values.gather(-1, actions[..., None])[..., 0]
        torch.testing.assert_close(chosen, values.max(-1).values, rtol=1e-5, atol=1e-5)
        of_actions = logits.gather(-1, actions[..., None]).sum((-1, -2))
        torch.testing.assert_close(logprobs, of_actions)


@pytest.mark.cuda
def test_actions_follow_their_probabilities():
    output = heads.output(spaces.MultiDiscrete(1, 4), 8).cuda()
    nn.init.normal_(output.linear.weight)
    x = torch.randn(1, 8, device="cuda").expand(200_000, -1)
    with torch.no_grad():
        logits, actions, _ = output.act(x, True, torch.Generator("cuda").manual_seed(1))
    shares = actions.flatten().bincount(minlength=4) / len(x)
    torch.testing.assert_close(shares, logits[0, 0].exp(), rtol=0, atol=5e-3)


def test_terms_match_the_plain_form(to_gpu):
    torch.manual_seed(0)
    output = heads.output(spaces.MultiDiscrete(2, 7), 8)
    logits = torch.randn(9, 33, 2, 7).log_softmax(-1).requires_grad_()
    actions = torch.randint(7, (9, 33, 2))
    plain = output.logprob(logits, actions), output.entropy(logits)
    on_gpu = to_gpu(logits.detach().clone()).requires_grad_()
    fused = output.terms(on_gpu, to_gpu(actions))
    weights = torch.randn(2, 9, 33)
    for one, other in zip(fused, plain, strict=True):
        torch.testing.assert_close(one.cpu(), other)
    losses = [
        sum((w.to(x.device) * x).sum() for w, x in zip(weights, terms)) for terms in (fused, plain)
    ]
    (d_fused,), (d_plain,) = (
        torch.autograd.grad(loss, leaf) for loss, leaf in zip(losses, (on_gpu, logits))
    )
    torch.testing.assert_close(d_fused.cpu(), d_plain)
