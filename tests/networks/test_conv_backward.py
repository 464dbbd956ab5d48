"""The gradients of the encoder `Conv` in one kernel, against autograd in float64."""

from types import SimpleNamespace

import pytest
import torch
from torch.nn import functional

from megastep.agents.networks.convolutions import conv_backward, n_outputs, takes

DEVICE = "cuda"
BF16 = torch.bfloat16
F = 32
NAMES = "first weight", "first bias", "second weight", "second bias"
# Of the largest number: hidden activations and their gradients are rounded to 8 bits.
TOLERANCE = 0.01


def make_inputs(n_rows, n_channels, n_columns, device=DEVICE):
    """Returns what `conv_backward` takes; a third of the features is 0."""
    torch.manual_seed(0)
    width = F * n_outputs(n_columns)
    features = (torch.randn(n_rows, width) + 0.43).relu()
    d_features, rows = torch.randn(n_rows, width), torch.randn(n_rows, n_channels, n_columns)
    weights = 0.3 * torch.randn(F, n_channels, 8), 0.3 * torch.randn(F), torch.randn(F, F, 4)
    return [each.to(device, BF16) for each in (d_features, features, rows, *weights)]


def plain(d_features, features, rows, first_weight, first_bias, second_weight):
    """Computes the gradients with autograd."""
    arguments = d_features, features, rows, first_weight, first_bias, second_weight
    d_features, features, rows, *leaves = (each.cpu().double() for each in arguments)
    leaves = [*leaves, torch.zeros(F, dtype=torch.float64)]
    first_weight, first_bias, second_weight, second_bias = (
        leaf.requires_grad_() for leaf in leaves
    )
    hidden = functional.conv1d(rows, first_weight, first_bias, stride=4, padding=4).relu()
    outputs = functional.conv1d(hidden, second_weight, second_bias, stride=2, padding=2)
    d_outputs = d_features.masked_fill(features <= 0, 0)
    return torch.autograd.grad(outputs.flatten(1), leaves, d_outputs)


def assert_close(results, expected, tolerance):
    for name, result, other in zip(NAMES, results, expected, strict=True):
        assert result.dtype == torch.float32 and result.shape == other.shape, name
        scale = tolerance * other.abs().max().item()
        error = (result.cpu() - other).abs().max().item()
        assert error <= scale, f"{name}: {error} > {scale}"


def assert_same(results, expected):
    for name, result, other in zip(NAMES, results, expected, strict=True):
        assert torch.equal(result, other), name


@pytest.mark.cuda
@pytest.mark.parametrize(
    "n_rows, n_channels, n_columns",
    [
        (1, 3, 128),
        (3, 1, 128),
        (1000, 1, 128),
        (1000, 3, 128),
        (20_011, 3, 128),
        (20_011, 1, 64),
        (100, 3, 256),
        (100, 8, 128),
        (100, 6, 36),
        (100, 5, 20),
        (100, 2, 127),
        (100, 3, 30),
        (100, 4, 4),
        (100, 1, 1),
    ],
)
def test_gradients(n_rows, n_channels, n_columns):
    inputs = make_inputs(n_rows, n_channels, n_columns)
    assert takes(inputs[2])
    assert_close(conv_backward(*inputs), plain(*inputs), TOLERANCE)


@pytest.mark.parametrize("n_channels, n_columns", [(3, 64), (8, 20), (5, 30), (1, 36)])
def test_gradients_in_every_order(cuda_on_cpu, monkeypatch, n_channels, n_columns):
    """Seven tiles of rows in two blocks."""
    inputs = make_inputs(100, n_channels, n_columns, "cpu")
    gpu = SimpleNamespace(multi_processor_count=1, shared_memory_per_multiprocessor=233_472)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: gpu)
    cuda_on_cpu.install(monkeypatch)
    results = cuda_on_cpu.in_every_order(lambda: conv_backward(*inputs))
    assert_close(results, plain(*inputs), TOLERANCE)


@pytest.mark.cuda
def test_numbers_that_need_no_rounding():
    """Products of small whole numbers and their sums are exact, so every term is there once."""
    inputs = make_inputs(50, 3, 128)
    inputs = [each.round().sign() for each in inputs]
    inputs[5] = inputs[5] * (torch.rand(F, F, 4).to(DEVICE) < 0.1)
    assert_close(conv_backward(*inputs), plain(*inputs), tolerance=0)


@pytest.mark.cuda
@pytest.mark.parametrize("offset", [8, 4, 1])
def test_rows_of_wider_tensors(offset):
    """Starts that are multiples of 16 bytes, of 8, and of neither."""
    d_features, features, rows, *weights = make_inputs(37, 3, 128)

    def widened(array):
        wide = torch.full((37, array.shape[1] + 24), torch.nan).to(array)
        part = wide[:, offset : offset + array.shape[1]]
        return part.copy_(array)

    wide_rows = widened(rows.flatten(1)).unflatten(1, (3, 128))
    inputs = widened(d_features), widened(features), wide_rows, *weights
    assert_same(conv_backward(*inputs), conv_backward(d_features, features, rows, *weights))


@pytest.mark.cuda
def test_gradients_pass_where_features_are_above_0_or_nan():
    inputs = make_inputs(37, 3, 128)
    d_features, features = inputs[:2]
    features[3, :9], features[36, 100] = 0, torch.nan
    d_features[3, :9] = torch.nan
    results = conv_backward(*inputs)
    assert_close(results, plain(*inputs), TOLERANCE)
    features[36, 100] = 0
    without = conv_backward(*inputs)
    features[36, 100] = 1
    assert_same(results, conv_backward(*inputs))
    assert not torch.equal(results[3], without[3])
