"""Spaces are small values with a shape."""

import pickle

import pytest

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


def test_spaces_do_not_change():
    with pytest.raises(AttributeError):
        spaces.MultiVector(2, 3).dim = 4


@pytest.mark.parametrize("bad", [0, -1, 2.5, True, "3", None])
def test_sizes_are_positive_integers(bad):
    with pytest.raises(ValueError, match="MultiVector needs a positive integer for dim, not"):
        spaces.MultiVector(1, bad)
