"""Arrays of arrays, on numpy and torch alike."""

import copy
import itertools
import pickle

import numpy as np
import pytest
import torch

from megastep.ragged import Ragged, RaggedNumpy, RaggedTorch

VALS, WIDTHS = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], [3, 1, 2]


@pytest.fixture(params=[np.array, torch.tensor], ids=["numpy", "torch"])
def kind(request):
    return request.param


@pytest.fixture
def ragged(kind):
    return Ragged(kind(VALS), kind(WIDTHS))


def test_the_kind_follows_the_values(kind, ragged):
    assert type(ragged) is {np.array: RaggedNumpy, torch.tensor: RaggedTorch}[kind]
    assert isinstance(ragged, Ragged) and type(ragged.starts) is type(ragged.vals)
    assert repr(ragged) == f"{type(ragged).__name__}([3 1 2])"


def test_attributes(ragged):
    assert ragged.vals.tolist() == VALS
    assert ragged.widths.tolist() == WIDTHS
    assert ragged.starts.tolist() == [0, 3, 4]
    assert ragged.ends.tolist() == [3, 4, 6]
    assert ragged.inverse.tolist() == [0, 0, 0, 1, 2, 2]
    assert len(ragged) == 3


def test_integers_give_subarrays(ragged):
    assert [ragged[i].tolist() for i in range(3)] == [[0, 1, 2], [3], [4, 5]]
    assert ragged[-1].tolist() == [4, 5] and ragged[-3].tolist() == [0, 1, 2]
    assert ragged[np.int32(1)].tolist() == ragged[torch.tensor(1)].tolist() == [3]
    assert [len(subarray) for subarray in ragged] == WIDTHS


@pytest.mark.parametrize("index", [3, -4, 100])
def test_integers_out_of_range_are_refused(ragged, index):
    with pytest.raises(
        IndexError, match=f"index {index} is out of range for a Ragged of 3 subarrays"
    ):
        ragged[index]


def test_other_indices_are_refused(ragged):
    with pytest.raises(TypeError, match="an integer or a slice, not a str"):
        ragged["a"]


def test_slices_agree_with_a_list_of_lists(ragged):
    for bounds in itertools.product(
        (None, 0, 1, 2, 3, 9, -1, -2), (None, 0, 1, 2, 5, -1), (None, 1, 2, -1, -2)
    ):
        index = slice(*bounds)
        made = ragged[index]
        assert type(made) is type(ragged) and made.vals.dtype == ragged.vals.dtype
        assert [subarray.tolist() for subarray in made] == [[0, 1, 2], [3], [4, 5]][index], index
        assert made.widths.tolist() == WIDTHS[index], index


def test_subarrays_and_plain_slices_are_views(ragged):
    ragged[0][1] = 10
    ragged[1:][0][0] = 30
    assert ragged.vals.tolist() == [0, 10, 2, 30, 4, 5]


def test_subarrays_may_be_empty_and_values_may_have_axes(kind):
    ragged = Ragged(kind(np.arange(12.0).reshape(3, 2, 2).tolist()), kind([0, 2, 0, 1, 0]))
    assert ragged[0].shape == (0, 2, 2) and ragged[3].tolist() == [[[8, 9], [10, 11]]]
    assert ragged.inverse.tolist() == [1, 1, 3]
    assert [len(subarray) for subarray in ragged[::-1]] == [0, 1, 0, 2, 0]
    assert len(Ragged(kind([]), [])) == 0 and len(Ragged(kind([]), [])[:]) == 0


def test_conversion_there_and_back():
    ragged = Ragged(np.array(VALS), np.array(WIDTHS))
    torched = ragged.torchify()
    assert isinstance(torched, RaggedTorch) and torched.vals.dtype == torch.float32
    assert torched.torchify() is torched and torched.numpyify().vals.tolist() == VALS
    assert isinstance(torched.numpyify(), RaggedNumpy) and ragged.numpyify() is ragged


def test_moving_and_cloning():
    ragged = Ragged(torch.tensor(VALS), torch.tensor(WIDTHS))
    assert (
        ragged.to(torch.float16).vals.dtype == torch.float16
        and ragged.cpu().widths.dtype == torch.int64
    )
    ragged.clone().vals[0] = 9
    assert ragged.vals[0] == 0


@pytest.mark.parametrize(
    "trip", [copy.copy, copy.deepcopy, lambda ragged: pickle.loads(pickle.dumps(ragged))]
)
def test_copies(ragged, trip):
    made = trip(ragged)
    assert (
        type(made) is type(ragged) and made[2].tolist() == [4, 5] and made.widths.tolist() == WIDTHS
    )


@pytest.mark.parametrize(
    ("widths", "error"),
    [
        ([3, 1], "add up to 4 and there are 6 vals"),
        ([3, -1, 4], r"must not be negative, but widths\[1\] is -1"),
        ([3.0, 3.0], "integers, but their dtype is .*float"),
        ([True] * 6, "integers, but their dtype is .*bool"),
        ([[3, 3]], r"exactly one axis, but theirs have shape \(1, 2\)"),
    ],
)
def test_bad_widths_are_refused_in_a_sentence(kind, widths, error):
    with pytest.raises(ValueError, match=error):
        Ragged(kind(VALS), kind(widths))


@pytest.mark.parametrize("name", ["vals", "widths"])
def test_values_are_written_in_place_and_never_replaced(ragged, name):
    with pytest.raises(AttributeError, match=f"{name} of a Ragged.* "):
        setattr(ragged, name, [1])
    with pytest.raises(AttributeError, match=f"{name} of a Ragged.* "):
        delattr(ragged, name)
    ragged.vals[:] = 6
    ragged.vals += 1
    assert ragged[2].tolist() == [7, 7]


def test_values_need_an_axis(kind):
    with pytest.raises(ValueError, match="at least one axis"):
        Ragged(kind(3.0), [1])


@pytest.mark.cuda
def test_on_the_gpu():
    ragged = Ragged(torch.tensor(VALS), torch.tensor(WIDTHS)).cuda()
    assert (
        ragged.starts.device.type
        == ragged.inverse.device.type
        == ragged[:2].widths.device.type
        == "cuda"
    )
    assert ragged[2].tolist() == [4, 5] and ragged.numpyify()[2].tolist() == [4, 5]
