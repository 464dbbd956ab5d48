"""Linear layers by the CPU's kernel against PyTorch."""

import pytest
import torch
from torch import nn

from megastep import engine
from megastep.agents.networks import layers, linear_cpu

# float32 sums in another order, of up to 3,000 products of about 1
SUMS = dict(rtol=1e-5, atol=2e-4)
# rows, depth, columns: whole tiles and blocks, parts of them, one number, many blocks, no rows
SHAPES = [(64, 128, 64), (7, 264, 70), (1, 1, 1), (5, 3000, 17), (130, 33, 16), (0, 4, 4)]


def sum_of_parts(parts, weight, bias, has_relu):
    y = nn.functional.linear(torch.cat(parts, -1), weight, bias)
    return y.relu() if has_relu else y


def by_kernel(parts, weight, bias, has_relu):
    return linear_cpu.CpuLinear.apply(weight, bias, has_relu, *parts)


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
    assert linear_cpu.matmul(a, b, out, bias) is out
    torch.testing.assert_close(out, a @ b + bias, **SUMS)
    out.copy_(before)
    linear_cpu.matmul(a, b, out, bias, adds=True, has_relu=True)
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
        results.append(linear_cpu.matmul(a, b))
    engine.set_threads(None)
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])
    for n_rows in (1, 6, 2048):
        assert torch.equal(linear_cpu.matmul(a[:n_rows], b), results[0][:n_rows])


def test_nan_passes_through_a_relu():
    a = torch.tensor([[torch.nan, -1.0]]).T
    out = linear_cpu.matmul(a, torch.ones(1, 1), has_relu=True)
    assert out[0].isnan() and out[1] == 0


def test_narrow_layers_and_other_dtypes_and_activations_use_pytorch():
    layer, narrow = nn.Linear(8, 16), nn.Linear(8, 15)
    x = torch.randn(3, 8)
    assert linear_cpu.fits(layer.weight, layer.bias, x)
    assert not linear_cpu.fits(narrow.weight, narrow.bias, x)
    assert not linear_cpu.fits(layer.weight, layer.bias, x.double())
    assert torch.equal(layers.linear(x, narrow, torch.relu), narrow(x).relu())
    assert torch.equal(layers.linear(x, layer, torch.tanh), layer(x).tanh())
    layer, x = layer.double(), x.double()
    assert torch.equal(layers.linear(x, layer, torch.relu), layer(x).relu())
