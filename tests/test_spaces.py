"""Spaces are small values with a shape."""

import pickle

import pytest
import torch

from megastep import spaces


def test_shapes():
    assert spaces.MultiVector(2, 3).shape == (2, 3)
    assert spaces.MultiImage(1, 3, 1, 64).shape == (1, 3, 1, 64)
    assert spaces.MultiDiscrete(2, 7).shape == (2,)
    assert spaces.MultiEmpty().shape == (0,)


def test_equality_hash_and_text_go_by_value():
    assert spaces.MultiVector(2, 3) == spaces.MultiVector(2, 3) != spaces.MultiVector(2, 4)
    assert spaces.MultiVector(2, 3) != spaces.MultiDiscrete(2, 3)
    assert (
        len(
            {
                spaces.MultiVector(2, 3),
                spaces.MultiVector(2, 3),
                spaces.MultiEmpty(),
                spaces.MultiEmpty(),
            }
        )
        == 2
    )
    assert repr(spaces.MultiDiscrete(2, 7)) == "MultiDiscrete(n_agents=2, n_actions=7)"
    assert pickle.loads(pickle.dumps(spaces.MultiImage(1, 3, 1, 64))) == spaces.MultiImage(
        1, 3, 1, 64
    )


def test_a_dtype_is_named_or_left_open():
    image, bytes_ = spaces.MultiImage(1, 3, 1, 8), spaces.MultiImage(1, 3, 1, 8, dtype=torch.uint8)
    assert image.dtype is None and bytes_.dtype == torch.uint8
    assert image != bytes_ and image.shape == bytes_.shape == (1, 3, 1, 8)
    assert repr(image) == "MultiImage(n_agents=1, C=3, H=1, W=8)"
    assert repr(bytes_) == "MultiImage(n_agents=1, C=3, H=1, W=8, dtype=torch.uint8)"
    with pytest.raises(ValueError, match=r"MultiVector can be of dtype torch.uint8.*not 'uint8'"):
        spaces.MultiVector(1, 3, dtype="uint8")


def test_spaces_do_not_change():
    with pytest.raises(AttributeError):
        spaces.MultiVector(2, 3).dim = 4


@pytest.mark.parametrize("bad", [0, -1, 2.5, True, "3", None])
def test_sizes_are_positive_integers(bad):
    with pytest.raises(ValueError, match="MultiVector needs a positive integer for dim, not"):
        spaces.MultiVector(1, bad)
