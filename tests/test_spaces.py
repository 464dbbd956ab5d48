"""Spaces are immutable values with a shape."""

import math
import pickle

import pytest
import torch

from megastep import spaces
from megastep.dotdict import dotdict


def test_equality_hash_repr_and_pickle_go_by_value():
    assert spaces.MultiVector(2, 3) == spaces.MultiVector(2, 3) != spaces.MultiVector(2, 4)
    assert spaces.MultiVector(2, 3) != spaces.MultiDiscrete(2, 3)
    vectors = {spaces.MultiVector(2, 3), spaces.MultiVector(2, 3)}
    assert len(vectors) == len({spaces.MultiEmpty(), spaces.MultiEmpty()}) == 1
    assert repr(spaces.MultiDiscrete(2, 7)) == "MultiDiscrete(n_agents=2, n_actions=7)"
    image = spaces.MultiImage(1, 3, 1, 64)
    assert pickle.loads(pickle.dumps(image)) == image


def test_dtype_is_optional():
    image, bytes_ = spaces.MultiImage(1, 3, 1, 8), spaces.MultiImage(1, 3, 1, 8, dtype=torch.uint8)
    assert image.dtype is None and bytes_.dtype == torch.uint8
    assert image != bytes_ and image.shape == bytes_.shape == (1, 3, 1, 8)
    assert repr(image) == "MultiImage(n_agents=1, C=3, H=1, W=8)"
    assert repr(bytes_) == "MultiImage(n_agents=1, C=3, H=1, W=8, dtype=torch.uint8)"
    with pytest.raises(ValueError, match=r"MultiVector .*dtype='uint8'.*torch\.uint8, torch\."):
        spaces.MultiVector(1, 3, dtype="uint8")


@pytest.mark.parametrize("bad", [0, -1, 2.5, True, "3", None])
def test_sizes_are_positive_integers(bad):
    with pytest.raises(ValueError, match=f"MultiVector .*positive integer .*dim.*{bad!r}"):
        spaces.MultiVector(1, bad)


# ---- Trees of spaces ----

RGB = spaces.MultiImage(1, 3, 1, 8)
SPEED = spaces.MultiVector(1, 2)
HANDS = spaces.MultiDiscrete(2, 4)
TREE = dotdict(rgb=RGB, body=dotdict(speed=SPEED, hands=HANDS), nothing=dotdict())


def test_leaves_are_named_by_dotted_path():
    assert spaces.leaves(TREE) == {"rgb": RGB, "body.speed": SPEED, "body.hands": HANDS}
    assert list(spaces.leaves(TREE, "obs")) == ["obs.rgb", "obs.body.speed", "obs.body.hands"]
    assert spaces.leaves(RGB, "obs") == {"obs": RGB} and spaces.leaves(RGB) == {"": RGB}


def test_bounds_of_continuous_actions_are_kept_per_number():
    space = spaces.MultiContinuous(1, 2, low=(0, -1), high=3)
    assert space.shape == (1, 2) and space == eval(repr(space), vars(spaces))
    assert space.low == (0.0, -1.0) and space.high == (3.0, 3.0)
    low, high = space.tensors()
    assert low.tolist() == [0, -1] and high.dtype == torch.float32


@pytest.mark.parametrize("bounds", [((0,), 1), (1, 1), (0, (1, -1)), (-math.inf, 1), (0, math.nan)])
def test_bounds_that_do_not_fit_are_refused(bounds):
    with pytest.raises(ValueError, match="MultiContinuous needs"):
        spaces.MultiContinuous(1, 2, *bounds)


@pytest.mark.parametrize("space", [HANDS, spaces.MultiContinuous(2, 3, (0, -1, 5), (1, 1, 1e4))])
def test_random_actions_are_actions_and_reach_every_part(space):
    actions = spaces.random_actions(space, 1000, generator=torch.Generator().manual_seed(1))
    assert actions.shape == (1000, *space.shape) and spaces.are_actions(space, actions)
    lowest, highest = (actions == 0, actions == 3)
    if isinstance(space, spaces.MultiContinuous):
        low, high = space.tensors()
        lowest, highest = actions < low + (high - low) / 10, actions > high - (high - low) / 10
    assert lowest.any(0).all() and highest.any(0).all()


@pytest.mark.parametrize(
    "space, wrong",
    [
        (HANDS, torch.tensor([[0, 4]])),
        (HANDS, torch.tensor([[0.0, 1.0]])),
        (HANDS, torch.tensor([[0]])),
        (spaces.MultiContinuous(1, 1), torch.tensor([[1.1]])),
        (spaces.MultiContinuous(1, 1), torch.tensor([[math.nan]])),
        (spaces.MultiContinuous(1, 1), torch.tensor([[1]])),
    ],
)
def test_what_is_no_action(space, wrong):
    assert not spaces.are_actions(space, wrong)
