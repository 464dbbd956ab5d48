"""Detection of non-finite numbers in rollouts and in saved state."""

from collections import OrderedDict

import pytest
import torch

from megastep.agents.algorithms.nonfinite import (
    LIMIT,
    NonFiniteCheck,
    NonFiniteValue,
    nonfinite_leaf,
)

T, B = 4, 3


def floats():
    """Returns tensors like those of `Rollout.floats`."""
    return {
        "obs.rgb": torch.rand(T + 1, B, 1, 3, 1, 8).half(),
        "obs.imu": torch.rand(T + 1, B, 1, 3),
        "reward": torch.rand(T, B),
        "value": torch.rand(T + 1, B),
        "logprob": -torch.rand(T, B),
    }


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf, 1.01 * LIMIT, -1e30])
@pytest.mark.parametrize("name", floats())
def test_nonfinite_value_has_name_lane_and_step(name, value):
    check, rollout = NonFiniteCheck("cpu"), floats()
    assert check(rollout)
    rollout[name][2, 1] = value  # infinite or NaN in float16
    assert not check(rollout)
    bad, _ = check.read(rollout)
    # the third row of the second rollout
    assert (bad.name, bad.lane, bad.step) == (name, 1, T + 3)
    assert not bad.size <= LIMIT and name in str(bad)


@pytest.mark.parametrize("name, value", [("obs.rgb", torch.nan), ("obs.imu", -1e30)])
def test_single_number_is_found(name, value):
    check, rollout = NonFiniteCheck("cpu"), floats()
    rollout[name][4, 2].view(-1)[1] = value
    assert not check(rollout)
    assert check.read(rollout)[0].step == 5


def test_largest_allowed_numbers_pass():
    check, rollout = NonFiniteCheck("cpu"), floats()
    rollout["reward"][0, 0], rollout["value"][0, 0] = 0.99 * LIMIT, -0.99 * LIMIT
    rollout["obs.rgb"][:] = 65504
    assert check(rollout) and check.read(rollout) == (None, 0)


def test_first_value_is_kept_until_read():
    check, good, bad = NonFiniteCheck("cpu"), floats(), floats()
    bad["reward"][1, 2] = 1e13
    worse = {name: values * torch.nan for name, values in good.items()}
    for rollout in (good, bad, worse, good):
        check(rollout)
    value, _ = check.read(good)
    assert value == NonFiniteValue("reward", 2, T + 2, pytest.approx(1e13))
    assert value.is_from_env
    assert all(part in str(value) for part in ("reward", "lane 2", "1e+13", f"step {T + 2}"))
    assert check.read(good)[0] is None
    check(worse)
    assert check.read(good)[0].step == 4 * T + 1


def test_consecutive_skipped_updates_are_counted():
    check, counts = NonFiniteCheck("cpu"), []
    for is_skipped in (False, True, True, False, True):
        check.count(torch.tensor(is_skipped))
        counts.append(check.read(floats())[1])
    assert counts == [0, 1, 2, 0, 1]


def test_nonfinite_leaf_returns_path():
    tree = {"policy": OrderedDict([("a.b", torch.ones(2)), ("c", torch.ones(()))]), "n": [1, 0.5]}
    tree |= {"none": None, "word": "nan", "generator": torch.zeros(3, dtype=torch.uint8)}
    assert nonfinite_leaf(tree) is None
    assert nonfinite_leaf({**tree, "n": [1, torch.inf]}) == "n.1"
    tree["policy"]["a.b"][1] = torch.nan
    assert nonfinite_leaf(tree) == "policy.a.b"


@pytest.mark.cuda
def test_check_never_synchronises():
    rollout = {name: values.cuda() for name, values in floats().items()}
    rollout["obs.imu"][3, 1] = torch.nan
    check = NonFiniteCheck(torch.device("cuda"))
    check(rollout)
    torch.cuda.set_sync_debug_mode("error")
    try:
        is_finite = check(rollout)
        check.count(~is_finite)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    bad, n_skipped = check.read(rollout)
    assert (bad.name, bad.lane, bad.step, n_skipped) == ("obs.imu", 1, 4, 1)
