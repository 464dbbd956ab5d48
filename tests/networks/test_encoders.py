"""Convolutions as banded matrices. test_heads.py tests encoders as part of intakes."""

import pytest
import torch

from megastep import spaces
from megastep.agents.networks import encoders


@pytest.mark.parametrize("shape", [(3, 128), (1, 64), (6, 37), (1, 5)])
def test_banded_matrix_matches_convolution(shape):
    channels, n_columns = shape
    conv = encoders.Conv(spaces.MultiImage(1, channels, 1, n_columns))
    rows = torch.rand(6, channels, n_columns, generator=torch.Generator().manual_seed(1))
    for layer in conv.first, conv.second:
        expected, product = layer(rows), layer.as_product(rows)
        torch.testing.assert_close(product, expected)
        weights = torch.rand(expected.shape, generator=torch.Generator().manual_seed(2))
        parameters = layer.weight, layer.bias
        torch.testing.assert_close(
            torch.autograd.grad((product * weights).sum(), parameters),
            torch.autograd.grad((expected * weights).sum(), parameters),
            rtol=1e-4,
            atol=1e-4,
        )
        rows = expected.detach()


@pytest.mark.parametrize("side, n_features", [(84, 64 * 7 * 7), (36, 64), (35, 64 * 9 * 9)])
def test_cnn_sees_every_pixel(side, n_features):
    """For 84 x 84 pixels the features of Mnih et al. 2015, 7 x 7 of 64 channels."""
    torch.manual_seed(1)
    cnn = encoders.Cnn(spaces.MultiImage(1, 3, side, side, dtype=torch.uint8))
    images = torch.rand(2, 1, 3, side, side, requires_grad=True)
    features = cnn(images)
    assert features.shape == (2, cnn.n_features) == (2, n_features)
    features[0].sum().backward()
    assert (images.grad[0] != 0).float().mean() > 0.95 and not images.grad[1].any()
    weight = cnn.layers[2].weight.flatten(1)  # orthogonal, so signals neither grow nor fade
    torch.testing.assert_close(weight @ weight.T, 2 * torch.eye(64), atol=1e-4, rtol=0)


@pytest.mark.cuda
@pytest.mark.parametrize("n_columns", [128, 2 * encoders.BandedConv1d.MAX_BANDED])
def test_gpu_matches_cpu(n_columns):
    conv = encoders.Conv(spaces.MultiImage(1, 3, 1, n_columns))
    image = torch.rand(7, 1, 3, 1, n_columns, generator=torch.Generator().manual_seed(1))
    expected = conv(image)
    torch.testing.assert_close(conv.cuda()(image.cuda()).cpu(), expected, rtol=1e-3, atol=1e-3)
