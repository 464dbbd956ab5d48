"""Convolutions by PyTorch and as one kernel. test_intakes.py tests encoders as part of intakes."""

import contextlib
from types import SimpleNamespace

import pytest
import torch
from torch.nn import functional

from megastep import spaces
from megastep.agents.networks import convolutions as kernels
from megastep.agents.networks import fused, heads
from megastep.agents.networks.linear import ComputeDtype
from megastep.arrdict import arrdict
from tests.networks.test_conv_backward import plain as gradients

BF16 = torch.bfloat16
# Both round hidden activations and features to 8 bits. The order of float32 sums decides a few
# roundings: of a feature by a unit of its last bit, of hidden activations by less than `atol`.
ROUNDING = dict(rtol=2**-7, atol=1e-2)


@pytest.mark.parametrize("side, n_features", [(84, 64 * 7 * 7), (36, 64), (35, 64 * 9 * 9)])
def test_cnn_sees_every_pixel(side, n_features):
    """For 84 x 84 pixels the features of Mnih et al. 2015, 7 x 7 of 64 channels."""
    torch.manual_seed(1)
    cnn = kernels.Cnn(spaces.MultiImage(1, 3, side, side, dtype=torch.uint8))
    images = torch.rand(2, 1, 3, side, side, requires_grad=True)
    features = cnn(images)
    assert features.shape == (2, cnn.n_features) == (2, n_features)
    features[0].sum().backward()
    assert (images.grad[0] != 0).float().mean() > 0.95 and not images.grad[1].any()
    weight = cnn.layers[2].weight.flatten(1)  # orthogonal, so signals neither grow nor fade
    torch.testing.assert_close(weight @ weight.T, 2 * torch.eye(64), atol=1e-4, rtol=0)


def convolve(rows, first_weight, first_bias, second_weight, second_bias, features=None):
    """The twin of `kernels.conv_forward`."""
    for weight, bias in ((first_weight, first_bias), (second_weight, second_bias)):
        stride = weight.shape[2] // 2  # which is the padding, too
        sums = functional.conv1d(rows.float(), weight.float(), bias.float(), stride, stride)
        rows = sums.relu().to(BF16)
    return rows.flatten(1) if features is None else features.copy_(rows.flatten(1))


IMAGE, VECTOR = spaces.MultiImage(1, 3, 1, 16), spaces.MultiVector(1, 3)


@pytest.mark.parametrize(
    "space, n_calls",
    [
        (dict(rgb=IMAGE, d=spaces.MultiImage(1, 1, 2, 37), imu=VECTOR, health=VECTOR), 2),
        (dict(rgb=spaces.MultiImage(2, 3, 1, 16), imu=VECTOR, near=spaces.MultiVector(2, 4)), 2),
        (dict(imu=spaces.MultiVector(1, 8), rgb=IMAGE), 1),
    ],
)
def test_an_intake_writes_features_side_by_side(space, n_calls, monkeypatch):
    """Also from columns in another order than that of the features, for two agents, and with
    gradients.
    """
    torch.manual_seed(1)
    intake = heads.intake(arrdict(space), 32, "conv")
    columns = torch.randn(5, 2, intake.n_columns).to(BF16)
    columns[..., intake.n_columns - 8 :] = 0
    calls, results = [], []

    def conv_forward(rows, *weights, features):
        calls.append(rows.shape)
        return convolve(rows, *weights, features)

    monkeypatch.setattr(kernels, "conv_forward", conv_forward)
    monkeypatch.setattr(kernels, "conv_backward", torch.enable_grad()(gradients))
    monkeypatch.setattr(fused, "uses_gpu", lambda: True)
    for is_supported in (True, False):
        monkeypatch.setattr(kernels, "takes", lambda rows, value=is_supported: value)
        with ComputeDtype("cpu", BF16):
            features = intake.encode_columns(columns)
        loss = features.float().square().sum()
        results.append([features, *torch.autograd.grad(loss, [*intake.encoders.parameters()])])
    assert len(calls) == n_calls
    assert features.shape == (5, 2, intake.n_features + intake.n_padding)
    for ours, plain in zip(*results, strict=True):
        assert ours.dtype == plain.dtype
        error = (ours.float() - plain.float()).norm() / plain.float().norm()
        assert error < 0.02, error  # 8 bits


def test_frozen_parameters_get_no_gradient(monkeypatch):
    intake = heads.intake(arrdict(rgb=IMAGE, d=IMAGE, near=IMAGE), 32, "conv")
    frozen = [*intake.encoders[0].parameters(), intake.encoders[1].first.weight]
    for leaf in frozen:
        leaf.requires_grad_(False)
    monkeypatch.setattr(kernels, "conv_forward", convolve)
    monkeypatch.setattr(kernels, "conv_backward", torch.enable_grad()(gradients))
    monkeypatch.setattr(kernels, "takes", lambda rows: True)
    with ComputeDtype("cpu", BF16):
        features = intake.encode_columns(torch.randn(5, intake.n_columns).to(BF16))
    features.float().sum().backward()
    for leaf in intake.encoders.parameters():
        assert (leaf.grad is None) == any(leaf is other for other in frozen)


def test_observations_that_need_gradients_and_odd_columns_are_left_to_pytorch(monkeypatch):
    monkeypatch.setattr(kernels, "takes", lambda rows: True)
    columns = torch.zeros(5, 48, dtype=BF16)
    encoder = kernels.Conv(IMAGE)

    def part(encoder, target):
        return kernels.Part(encoder, slice(0, 48), slice(target, target + 96))

    assert kernels._can_encode(columns, [part(encoder, 0), part(None, 96)])
    last = kernels.Part(None, slice(0, 5), slice(99, 104))
    assert not kernels._can_encode(columns, [part(encoder, 3), last])
    assert not kernels._can_encode(columns, [part(encoder, 0), last._replace(target=slice(96, 99))])
    assert not kernels._can_encode(columns.requires_grad_(), [part(encoder, 0)])


def weights_of(conv, device="cuda"):
    """The weights, with biases that matter, in bfloat16."""
    for layer in conv.first, conv.second:
        layer.bias.data.normal_()
    return [leaf.detach().to(device, BF16) for leaf in conv.parameters()]


@pytest.mark.parametrize("shape", [(3, 128), (6, 37), (1, 5)])
def test_kernel_matches_convolutions_in_every_order(cuda_on_cpu, monkeypatch, shape):
    """Seven tiles of rows in two blocks."""
    torch.manual_seed(1)
    conv = kernels.Conv(spaces.MultiImage(1, shape[0], 1, shape[1]))
    weights, rows = weights_of(conv, "cpu"), torch.randn(100, *shape).to(BF16)
    gpu = SimpleNamespace(multi_processor_count=1)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: gpu)
    cuda_on_cpu.install(monkeypatch)
    (features,) = cuda_on_cpu.in_every_order(lambda: [kernels.conv_forward(rows, *weights)])
    torch.testing.assert_close(features, convolve(rows, *weights), **ROUNDING)


@pytest.mark.cuda
@pytest.mark.parametrize("n_rows", [1, 37, 9_001])  # more tiles than blocks
@pytest.mark.parametrize(
    "shape", [(3, 128), (1, 128), (1, 64), (3, 16), (6, 37), (2, 7), (1, 5), (8, 192), (5, 250)]
)
def test_kernel_matches_convolutions(shape, n_rows):
    torch.manual_seed(1)
    conv = kernels.Conv(spaces.MultiImage(1, shape[0], 1, shape[1]))
    weights = weights_of(conv)
    rows = torch.randn(n_rows, *shape).to("cuda", BF16)
    assert kernels.takes(rows)
    features = torch.full((n_rows, conv.n_features + 16), torch.nan, dtype=BF16, device="cuda")
    ours = kernels.conv_forward(rows, *weights, features[:, 8:-8])
    expected = convolve(rows.cpu(), *(weight.cpu() for weight in weights))
    torch.testing.assert_close(ours.cpu(), expected, **ROUNDING)
    assert (ours.cpu() == expected).float().mean() > 0.9
    assert features[:, :8].isnan().all() and features[:, -8:].isnan().all()
    assert torch.equal(kernels.conv_forward(rows, *weights), ours)  # same bits twice
    with torch.autocast("cuda", BF16), torch.no_grad():
        assert torch.equal(conv.cuda()(rows[:, None, :, None]), ours)


@pytest.mark.cuda
@pytest.mark.parametrize("shape", [(1, 3, 1, 128), (2, 1, 2, 64)])
def test_gradients_through_the_kernel(shape, monkeypatch):
    torch.manual_seed(1)
    calls, conv_forward = [], kernels.conv_forward
    monkeypatch.setattr(
        kernels, "conv_forward", lambda *args, **at: calls.append(args) or conv_forward(*args, **at)
    )
    conv = kernels.Conv(spaces.MultiImage(*shape)).cuda()
    images = torch.randn(300, *shape, device="cuda")
    results = []
    for context in (ComputeDtype("cuda", BF16), contextlib.nullcontext()):
        with context:
            features = conv(images)
        loss = features.float().square().sum()
        results.append([features, *torch.autograd.grad(loss, conv.parameters())])
    assert len(calls) == 1
    for ours, plain in zip(*results, strict=True):
        error = (ours.float() - plain).norm() / plain.norm()
        assert error < 0.05, error  # 8 bits, and ReLUs near their kink
