"""Raggeds of numpy arrays and of tensors."""

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


@pytest.mark.parametrize("index", [3, -4, 100])
def test_an_index_out_of_range_is_refused(ragged, index):
    with pytest.raises(IndexError, match=f"{index} .*out of range .*3"):
        ragged[index]


def test_an_index_of_another_type_is_refused(ragged):
    with pytest.raises(TypeError, match="integer or a slice.* str"):
        ragged["a"]


def test_torchify_and_numpyify():
    ragged = Ragged(np.array(VALS), np.array(WIDTHS))
    converted = ragged.torchify()
    assert isinstance(converted, RaggedTorch) and converted.vals.dtype == torch.float32
    assert converted.torchify() is converted and converted.numpyify().vals.tolist() == VALS
    assert isinstance(converted.numpyify(), RaggedNumpy) and ragged.numpyify() is ragged


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
