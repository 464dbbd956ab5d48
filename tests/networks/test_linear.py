"""Linear layers against PyTorch: by kernels on a GPU, or on a CPU that stands for one, and by the
CPU's own. Also what is remembered of weights.
"""

from types import SimpleNamespace

import pytest
import torch
from torch import nn

from megastep import engine
from megastep.agents.networks import linear
from megastep.agents.networks.fused import aligned_rows
from megastep.agents.networks.linear import ComputeDtype, cast, cast_joined, rounded
from tests.networks.test_intakes import assert_close


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


def test_weights_are_rounded_as_by_pytorch(to_gpu):
    """More than fit into a launch; some fill several blocks, others no vector of eight."""
    torch.manual_seed(0)
    shapes = [*((n,) for n in range(1, 50)), (7, 3), (1, 256), (100, 264), (33, 8, 2)]
    weights = [torch.randn(shape) for shape in shapes]
    weights[3][0], weights[4][1] = torch.nan, torch.inf
    for weight, ours in zip(weights, rounded([*map(to_gpu, weights)]), strict=True):
        assert len(ours) == -(-len(weight) // 8) * 8 and not ours[len(weight) :].any()
        expected = weight.bfloat16()
        torch.testing.assert_close(
            ours[: len(weight)].cpu(), expected, rtol=0, atol=0, equal_nan=True
        )


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
            y = linear.linear(x, layer, activation)
        assert y.dtype == (torch.bfloat16 if is_fused else torch.float32)
        assert ("_Layer" in type(y.grad_fn).__name__) == is_fused
        # a unit near 0 may be on either side of the ReLU's kink
        kept = (y.abs() > 0.05) if activation else torch.ones_like(y, dtype=torch.bool)
        results.append((y.detach(), kept))
    is_kept = results[0][1] & results[1][1]
    gradients = []
    for is_fused in (True, False):
        with torch.autocast("cuda", torch.bfloat16, enabled=is_fused):
            y = linear.linear(x, layer, activation)
        loss = (y * d.to(y.dtype) * is_kept).float().sum()
        gradients.append(torch.autograd.grad(loss, [x, *layer.parameters()]))
    assert_close(results[0][0], results[1][0])
    for fused, plain in zip(*gradients, strict=True):
        assert fused.dtype == torch.float32
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
            y = linear.linear(x, layer)
            joined = torch.cat([y.new_zeros(1, 3), y], 1)
        d = torch.arange(11.0, device="cuda", dtype=joined.dtype)[None]
        gradients.append(torch.autograd.grad(joined, layer.bias, d)[0])
    assert torch.equal(gradients[0], gradients[1])


def test_nan_passes_the_gradient_of_a_relu(to_gpu):
    d = to_gpu(torch.randn(3, 8).bfloat16())
    y = to_gpu(torch.tensor([torch.nan, 1.0, 0.0]).bfloat16()[:, None].expand(3, 8))
    masked, _ = linear._bias_gradient_on_gpu(d, y.contiguous())
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
    masked, sums = linear._bias_gradient_on_gpu(d, y)
    assert torch.equal(masked, d.masked_fill(y <= 0, 0.0))
    expected = masked.double().sum(0).float()
    torch.testing.assert_close(sums, expected, rtol=1e-4, atol=1e-5 * n_rows**0.5 + 1e-3)
    assert torch.equal(linear._bias_gradient_on_gpu(d, y)[1], sums)
    wide = to_gpu(torch.randn(n_rows, n_columns + 16).bfloat16())
    wide[:, 8:-8] = d
    ours = linear._bias_gradient_on_gpu(wide[:, 8:-8], y)
    assert torch.equal(ours[0], masked) and torch.equal(ours[1], sums)
    same, sums = linear._bias_gradient_on_gpu(d)
    assert torch.equal(same, d)
    expected = d.double().sum(0).float()
    torch.testing.assert_close(sums, expected, rtol=1e-4, atol=1e-5 * n_rows**0.5 + 1e-3)


# ---- On a CPU ----

# float32 sums in another order, of up to 3,000 products of about 1
SUMS = dict(rtol=1e-5, atol=2e-4)
# rows, depth, columns: whole tiles and blocks, parts of them, one number, many blocks, no rows
SHAPES = [(64, 128, 64), (7, 264, 70), (1, 1, 1), (5, 3000, 17), (130, 33, 16), (0, 4, 4)]


def sum_of_parts(parts, weight, bias, has_relu):
    y = nn.functional.linear(torch.cat(parts, -1), weight, bias)
    return y.relu() if has_relu else y


def by_kernel(parts, weight, bias, has_relu):
    layer = SimpleNamespace(weight=weight, bias=bias)
    return linear.linear(tuple(parts), layer, torch.relu if has_relu else None)


def with_gradients(function, lead, sizes, n_outputs, has_relu):
    """Returns the outputs of a layer and all gradients."""
    torch.manual_seed(0)
    parts = [torch.randn(size, *lead).movedim(0, -1) for size in sizes]  # not contiguous
    leaves = [*parts, torch.randn(n_outputs, sum(sizes)), torch.randn(n_outputs)]
    leaves = [leaf.requires_grad_() for leaf in leaves]
    y = function(leaves[:-2], *leaves[-2:], has_relu)
    return [y, *torch.autograd.grad(y, leaves, torch.randn(y.shape))]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("transposed", ["", "a", "b", "ab"])
def test_products_match_pytorch(shape, transposed):
    n_rows, depth, n_columns = shape
    a = torch.randn(depth, n_rows).T if "a" in transposed else torch.randn(n_rows, depth)
    b = torch.randn(n_columns, depth).T if "b" in transposed else torch.randn(depth, n_columns)
    bias, before = torch.randn(n_columns), torch.randn(n_rows, n_columns)
    wide = torch.full((n_rows, n_columns + 2), torch.nan)
    out = wide[:, 1:-1]
    assert linear.matmul(a, b, out, bias) is out
    torch.testing.assert_close(out, a @ b + bias, **SUMS)
    out.copy_(before)
    linear.matmul(a, b, out, bias, adds=True, has_relu=True)
    torch.testing.assert_close(out, (before + a @ b + bias).relu(), **SUMS)
    assert wide[:, [0, -1]].isnan().all()  # nothing is written beside it


@pytest.mark.parametrize("has_relu", [False, True])
@pytest.mark.parametrize("sizes", [(264,), (64, 48)], ids=str)
@pytest.mark.parametrize("lead", [(), (9,), (8, 33)], ids=str)
def test_layers_match_pytorch(lead, sizes, has_relu):
    arguments = lead, sizes, 70, has_relu
    expected = with_gradients(sum_of_parts, *arguments)
    for ours, theirs in zip(with_gradients(by_kernel, *arguments), expected, strict=True):
        torch.testing.assert_close(ours, theirs, **SUMS)


def test_bits_depend_neither_on_threads_nor_on_the_number_of_rows():
    torch.manual_seed(0)
    a, b = torch.randn(2051, 264), torch.randn(264, 70)
    results = []
    for n_threads in (1, 2, 3):
        engine.set_threads(n_threads)
        results.append(linear.matmul(a, b))
    engine.set_threads(None)
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])
    for n_rows in (1, 6, 2048):
        assert torch.equal(linear.matmul(a[:n_rows], b), results[0][:n_rows])


def test_nan_passes_through_a_relu():
    a = torch.tensor([[torch.nan, -1.0]]).T
    out = linear.matmul(a, torch.ones(1, 1), has_relu=True)
    assert out[0].isnan() and out[1] == 0


def test_narrow_layers_and_other_dtypes_and_activations_use_pytorch():
    layer, narrow = nn.Linear(8, 16), nn.Linear(8, 15)
    x = torch.randn(3, 8)
    assert torch.equal(linear.linear(x, narrow, torch.relu), narrow(x).relu())
    assert torch.equal(linear.linear(x, layer, torch.tanh), layer(x).tanh())
    layer, x = layer.double(), x.double()
    assert torch.equal(linear.linear(x, layer, torch.relu), layer(x).relu())
