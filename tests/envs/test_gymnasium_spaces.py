"""Gymnasium's spaces as ours, and batches of values in both directions."""

import numpy as np
import pytest
import torch

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.dotdict import dotdict, leaves

gym = pytest.importorskip("gymnasium.spaces")
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate  # noqa: E402

from megastep.hosting.conversions import actions, observation  # noqa: E402

N = 5
vector, image, discrete = spaces.MultiVector, spaces.MultiImage, spaces.MultiDiscrete
F32, U8 = {"dtype": torch.float32}, {"dtype": torch.uint8}
OBSERVATIONS = [
    (gym.Box(-np.inf, np.inf, (4,)), vector(1, 4, **F32)),
    (gym.Box(0, 1, ()), vector(1, 1, **F32)),
    (gym.Box(0, 255, (7, 7, 3), np.uint8), vector(1, 147, **F32)),
    (gym.Box(0, 255, (8, 9, 3), np.uint8), image(1, 3, 8, 9, **U8)),
    (gym.Box(0, 255, (4, 8, 9), np.uint8), image(1, 4, 8, 9, **U8)),
    (gym.Box(0, 1, (8, 9, 1), np.float64), image(1, 1, 8, 9, **F32)),
    (gym.Box(0, 255, (8, 9), np.uint8), image(1, 1, 8, 9, **U8)),
    (gym.Box(0, 1, (16, 17)), image(1, 1, 16, 17, **F32)),
    (gym.Box(0, 1, (8, 17)), vector(1, 136, **F32)),
    (gym.Box(-np.inf, np.inf, (16, 17)), vector(1, 272, **F32)),  # a stack of vectors
    (gym.Box(0, 255, (12, 20, 30), np.uint8), image(1, 12, 20, 30, **U8)),
    (gym.Box(0, 1, (8, 8, 111)), image(1, 111, 8, 8, **F32)),
    (gym.Box(-np.arange(512, dtype=np.float32).reshape(8, 8, 8), 1), vector(1, 512, **F32)),
    (gym.Box(0, 255, (5, 8, 9, 3), np.uint8), image(1, 15, 8, 9, **U8)),
    (gym.Box(0, 255, (5, 3, 8, 9), np.uint8), image(1, 15, 8, 9, **U8)),
    (gym.Discrete(5, start=-2), discrete(1, 5)),
    (gym.MultiDiscrete([3, 3], start=[1, 4]), discrete(2, 3)),
    (gym.MultiDiscrete([3, 4]), dotdict(part_0=discrete(1, 3), part_1=discrete(1, 4))),
    (gym.MultiBinary((2, 2)), vector(1, 4, **F32)),
    (
        gym.Dict({"a-b": gym.Discrete(2), "c": gym.Tuple([gym.Discrete(3), gym.Box(0, 1)])}),
        dotdict(a_b=discrete(1, 2), c=dotdict(part_0=discrete(1, 3), part_1=vector(1, 1, **F32))),
    ),
    (
        gym.Dict({"a b": gym.Discrete(2), "a_b": gym.Discrete(3)}),
        dotdict(a_b=discrete(1, 2), a_b_=discrete(1, 3)),
    ),
    (
        gym.Dict({"values": gym.Discrete(2), "forward": gym.Discrete(3)}),
        dotdict(forward_=discrete(1, 3), values_=discrete(1, 2)),
    ),
]
ACTIONS = [
    (gym.Discrete(5, start=-2), discrete(1, 5)),
    (gym.MultiDiscrete([3, 3], start=[1, 4]), discrete(2, 3)),
    (
        gym.MultiDiscrete([[3, 4], [5, 6]]),
        dotdict({f"part_{i}": discrete(1, 3 + i) for i in range(4)}),
    ),
    (gym.MultiBinary((2, 2)), discrete(4, 2)),
    (gym.Box(-2, 2, (2, 3)), spaces.MultiContinuous(1, 6, -2, 2)),
    (gym.Box(np.array([-0.1, 0]), np.array([0.1, 1]), dtype=np.float64), None),
    (gym.Box(0, 3, (2,), np.int32), spaces.MultiContinuous(1, 2, 0, 3)),
    (
        gym.Dict(move=gym.Tuple([gym.Discrete(2), gym.Box(-1, 1, (1,))]), jump=gym.Discrete(3)),
        dotdict(
            move=dotdict(part_0=discrete(1, 2), part_1=spaces.MultiContinuous(1, 1)),
            jump=discrete(1, 3),
        ),
    ),
]


def named(pairs):
    return pytest.mark.parametrize("space, ours", pairs, ids=[str(pair[0]) for pair in pairs])


@named(OBSERVATIONS)
def test_observations(space, ours):
    space.seed(1)
    found, read = observation(space)
    assert repr(found) == repr(ours)
    samples = [space.sample() for _ in range(N)]
    arrays = read(concatenate(space, samples, create_empty_array(space, N)))
    for leaf, array in zip(leaves(found), leaves(arrays), strict=True):
        assert array.shape == (N, *leaf.shape)
        if isinstance(leaf, spaces.MultiDiscrete):
            assert (array >= 0).all() and (array < leaf.n_actions).all() and array.any()
        elif isinstance(space, gym.Box):
            assert sorted(array[3].flat) == sorted(np.asarray(samples[3]).flat)


def test_image_with_channels_last_is_turned():
    _, read = observation(gym.Box(0, 255, (8, 9, 3), np.uint8))
    pixels = np.arange(8 * 9 * 3, dtype=np.uint8).reshape(1, 8, 9, 3)
    assert read(pixels)[0, 0, 2, 4, 5] == pixels[0, 4, 5, 2]


def test_stacked_images_are_channels_one_after_the_other():
    _, read = observation(gym.Box(0, 255, (2, 8, 9, 3), np.uint8))
    pixels = np.random.default_rng(1).integers(256, size=(1, 2, 8, 9, 3), dtype=np.uint8)
    assert read(pixels)[0, 0, 5, 4, 7] == pixels[0, 1, 4, 7, 2]


@named(ACTIONS)
def test_actions_are_in_the_space(space, ours):
    """All corners of our space, and what is between."""
    found, write = actions(space)
    assert ours is None or repr(found) == repr(ours)

    def draw(leaf):
        if isinstance(leaf, spaces.MultiDiscrete):
            return np.random.default_rng(1).integers(leaf.n_actions, size=(N, *leaf.shape))
        low, high = (bound.numpy() for bound in leaf.tensors())
        return np.stack([low, high, low + (high - low) / 3, high, low])[:, None]

    batch = write(spaces.map(draw, found))
    items = [*iterate(batch_space(space, N), batch)]
    assert len(items) == N and all(map(space.contains, items))


def test_each_action_goes_to_its_place():
    space = gym.MultiDiscrete([[3, 4], [5, 6]], start=[[0, 0], [10, 0]])
    _, write = actions(space)
    batch = write(arrdict({f"part_{i}": np.array([[i]]) for i in range(4)}))
    assert batch.tolist() == [[[0, 1], [12, 3]]]
    _, write = actions(gym.Box(np.array([[0, -5]]), np.array([[1, 5]]), dtype=np.float32))
    assert write(np.array([[[0.25, -7]]], np.float32)).tolist() == [[[0.25, -5]]]


@pytest.mark.parametrize(
    "convert, space, message",
    [
        (observation, gym.Sequence(gym.Discrete(2)), "observation is a Sequence"),
        (observation, gym.Dict(a=gym.Text(3)), r"observation\['a'\] is a Text"),
        (observation, gym.Box(0, 1, (0,)), "observation is Box.*which no encoder takes"),
        (actions, gym.Tuple([gym.Text(3)]), r"action\[0\] is a Text.*which no output chooses"),
        (actions, gym.Box(0, np.inf), "action is Box.*need finite bounds"),
        (actions, gym.Box(1, 1), "action is Box.*each low below its high"),
        (actions, gym.Box(-3e38, 3e38), "action is Box.*between which float32 has numbers"),
        (actions, gym.Box(0, 1e300, dtype=np.float64), "action is Box.*need finite bounds"),
    ],
)
def test_space_that_nothing_takes_is_named(convert, space, message):
    with pytest.raises(ValueError, match=f"^{message}.*env.wrappers="):
        convert(space)
