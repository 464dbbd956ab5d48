"""Ranks that differ are told, with the field or the tensor in which they do."""

import pytest
import torch

from megastep.agents.distributed import drift
from megastep.agents.distributed.drift import check_drift, first_difference
from megastep.agents.errors import UserError
from megastep.agents.launch import rank_checks
from tests.helpers import ranks


@pytest.mark.parametrize(
    "dtype", [torch.float32, torch.float16, torch.int64, torch.bool, torch.complex64]
)
def test_checksum_sees_one_bit(dtype):
    tensor = torch.ones(3, 5, dtype=dtype)
    other = tensor.clone()
    other[1, 2] = 0
    before, same, after = (drift.checksums([x]) for x in (tensor, tensor.clone(), other))
    assert torch.equal(before, same) and not torch.equal(before, after)


def test_checksum_sees_negative_zero_and_nan():
    values = torch.tensor([0.0, -0.0, torch.nan, torch.inf])
    assert len({drift.checksums([value]).item() for value in values}) == 4


def test_one_process_cannot_drift():
    check_drift(torch.nn.Linear(2, 2))


@pytest.mark.parametrize(
    "everyones, expected",
    [
        ([{"a": "1", "b": "2"}, {"a": "1", "b": "3"}], "b is 2 on rank 0, and 3 on rank 1"),
        ([{"a": "1"}, {"a": "2"}, {"a": "1"}], "a is 1 on ranks 0 and 2, and 2 on rank 1"),
        ([{}, {"a": "1"}], "a is missing on rank 0, and 1 on rank 1"),
    ],
)
def test_first_differing_fact(monkeypatch, everyones, expected):
    rank_checks.check_equal({"a": 1})
    monkeypatch.setattr(rank_checks.process_group, "gather_objects", lambda facts: everyones)
    with pytest.raises(UserError, match=f"^The ranks differ: {expected}; start all with the same "):
        rank_checks.check_equal({})


def test_first_difference_names_tensor_and_ranks(monkeypatch):
    network = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.BatchNorm1d(2))
    monkeypatch.setattr(drift, "n_ranks", lambda: 3)

    def gather(sums):
        rows = sums.repeat(3, 1)
        rows[1:, 1] += 1  # of 0.weight, 0.bias, ...
        rows[2, 4] += 1
        return rows

    monkeypatch.setattr(drift, "all_gather", gather)
    assert first_difference(network) == "policy.0.bias differs on ranks 1 and 2"
    with pytest.raises(drift.DriftError, match="average_gradients"):
        check_drift(network)


def drifted(has_buffer):
    from megastep.agents.distributed import process_group

    torch.manual_seed(1)
    network = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.BatchNorm1d(2))
    equal = first_difference(network)
    tensor = network[1].running_mean if has_buffer else network[0].bias
    with torch.no_grad():
        tensor[1] += 1e-6 * process_group.rank()
    return equal, first_difference(network)


@pytest.mark.slow
@pytest.mark.parametrize("has_buffer, name", [(False, "0.bias"), (True, "1.running_mean")])
def test_two_ranks_drift(has_buffer, name):
    expected = (None, f"policy.{name} differs on rank 1")
    assert ranks.call(drifted, has_buffer) == [expected, expected]
