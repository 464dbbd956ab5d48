"""Raggeds of numpy arrays and of tensors."""

import copy
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


def test_class_follows_the_values(kind, ragged):
    assert type(ragged) is {np.array: RaggedNumpy, torch.tensor: RaggedTorch}[kind]
    assert isinstance(ragged, Ragged) and type(ragged.starts) is type(ragged.vals)
    assert repr(ragged) == f"{type(ragged).__name__}([3 1 2])"


def test_an_integer_index_returns_a_subarray(ragged):
    assert [ragged[i].tolist() for i in range(3)] == [[0, 1, 2], [3], [4, 5]]
    assert ragged[-1].tolist() == [4, 5] and ragged[-3].tolist() == [0, 1, 2]
    assert ragged[np.int32(1)].tolist() == ragged[torch.tensor(1)].tolist() == [3]
    assert [len(subarray) for subarray in ragged] == WIDTHS


@pytest.mark.parametrize("index", [3, -4, 100])
def test_an_index_out_of_range_is_refused(ragged, index):
    with pytest.raises(IndexError, match=f"{index} .*out of range .*3"):
        ragged[index]


def test_an_index_of_another_type_is_refused(ragged):
    with pytest.raises(TypeError, match="integer or a slice.* str"):
        ragged["a"]


def test_subarrays_and_slices_without_a_step_are_views(ragged):
    ragged[0][1] = 10
    ragged[1:][0][0] = 30
    assert ragged.vals.tolist() == [0, 10, 2, 30, 4, 5]


def test_empty_subarrays_and_further_axes(kind):
    ragged = Ragged(kind(np.arange(12.0).reshape(3, 2, 2).tolist()), kind([0, 2, 0, 1, 0]))
    assert ragged[0].shape == (0, 2, 2) and ragged[3].tolist() == [[[8, 9], [10, 11]]]
    assert ragged.inverse.tolist() == [1, 1, 3]
    assert [len(subarray) for subarray in ragged[::-1]] == [0, 1, 0, 2, 0]
    assert len(Ragged(kind([]), [])) == 0 and len(Ragged(kind([]), [])[:]) == 0


def test_torchify_and_numpyify():
    ragged = Ragged(np.array(VALS), np.array(WIDTHS))
    converted = ragged.torchify()
    assert isinstance(converted, RaggedTorch) and converted.vals.dtype == torch.float32
    assert converted.torchify() is converted and converted.numpyify().vals.tolist() == VALS
    assert isinstance(converted.numpyify(), RaggedNumpy) and ragged.numpyify() is ragged


def test_to_cpu_and_clone():
    ragged = Ragged(torch.tensor(VALS), torch.tensor(WIDTHS))
    assert ragged.to(torch.float16).vals.dtype == torch.float16
    assert ragged.cpu().widths.dtype == torch.int64
    ragged.clone().vals[0] = 9
    assert ragged.vals[0] == 0


@pytest.mark.parametrize(
    "make_copy", [copy.copy, copy.deepcopy, lambda ragged: pickle.loads(pickle.dumps(ragged))]
)
def test_copies(ragged, make_copy):
    copied = make_copy(ragged)
    assert type(copied) is type(ragged)
    assert copied[2].tolist() == [4, 5] and copied.widths.tolist() == WIDTHS


@pytest.mark.parametrize(
    ("widths", "error"),
    [
        ([3, 1], "6 vals.* 4$"),
        ([3, -1, 4], r"must not be negative, but widths\[1\] is -1"),
        ([3.0, 3.0], "integers.*float"),
        ([True] * 6, "integers.*bool"),
        ([[3, 3]], r"one axis.* \(1, 2\)"),
    ],
)
def test_wrong_widths_are_refused(kind, widths, error):
    with pytest.raises(ValueError, match=error):
        Ragged(kind(VALS), kind(widths))


@pytest.mark.parametrize("name", ["vals", "widths"])
def test_values_can_be_written_but_not_replaced(ragged, name):
    with pytest.raises(AttributeError, match=f"{name} of a Ragged.* "):
        setattr(ragged, name, [1])
    with pytest.raises(AttributeError, match=f"{name} of a Ragged.* "):
        delattr(ragged, name)
    ragged.vals[:] = 6
    ragged.vals += 1
    assert ragged[2].tolist() == [7, 7]


@pytest.mark.cuda
def test_on_the_gpu():
    ragged = Ragged(torch.tensor(VALS), torch.tensor(WIDTHS)).cuda()
    for tensor in (ragged.starts, ragged.inverse, ragged[:2].widths):
        assert tensor.device.type == "cuda"
    assert ragged[2].tolist() == [4, 5] and ragged.numpyify()[2].tolist() == [4, 5]
