"""Finding numbers that cannot be learnt from, in rollouts and in what is saved."""

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


def numbers():
    """As a rollout has them: one row more of what is seen than of what follows."""
    return {
        "obs.rgb": torch.rand(T + 1, B, 1, 3, 1, 8).half(),
        "obs.imu": torch.rand(T + 1, B, 1, 3),
        "reward": torch.rand(T, B),
        "value": torch.rand(T + 1, B),
        "logprob": -torch.rand(T, B),
    }


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf, 1.01 * LIMIT, -1e30])
@pytest.mark.parametrize("name", numbers())
def test_a_bad_number_is_named_with_its_lane_and_step(name, value):
    check, rollout = NonFiniteCheck("cpu"), numbers()
    assert check(rollout)
    rollout[name][2, 1] = value  # in float16, all of these are infinite or no number
    assert not check(rollout)
    bad, _ = check.read(rollout)
    # the third row of the second rollout
    assert (bad.name, bad.lane, bad.step) == (name, 1, T + 3)
    assert not bad.size <= LIMIT and str(bad).startswith(f"{name} of lane 1 was ")


def test_one_pixel_is_enough():
    check, rollout = NonFiniteCheck("cpu"), numbers()
    rollout["obs.rgb"][4, 2, 0, 1, 0, 7] = torch.nan
    assert not check(rollout)
    assert check.read(rollout)[0].step == 5


def test_the_largest_numbers_that_can_be_learnt_from_are_fine():
    check, rollout = NonFiniteCheck("cpu"), numbers()
    rollout["reward"][0, 0], rollout["value"][0, 0] = 0.99 * LIMIT, -0.99 * LIMIT
    rollout["obs.rgb"][:] = 65504
    assert check(rollout) and check.read(rollout) == (None, 0)


def test_the_first_is_remembered_until_it_is_read():
    check, good, bad = NonFiniteCheck("cpu"), numbers(), numbers()
    bad["reward"][1, 2] = 1e13
    worse = {name: values * torch.nan for name, values in good.items()}
    for rollout in (good, bad, worse, good):
        check(rollout)
    found, _ = check.read(good)
    assert found == NonFiniteValue("reward", 2, T + 2, pytest.approx(1e13))
    assert found.is_from_env and str(found) == f"reward of lane 2 was 1e+13 at step {T + 2}"
    assert check.read(good)[0] is None
    check(worse)
    assert check.read(good)[0].step == 4 * T + 1


def test_updates_skipped_in_a_row_are_counted():
    check, counts = NonFiniteCheck("cpu"), []
    for is_skipped in (False, True, True, False, True):
        check.count(torch.tensor(is_skipped))
        counts.append(check.read(numbers())[1])
    assert counts == [0, 1, 2, 0, 1]


def test_what_is_not_finite_in_a_tree_is_named():
    tree = {"policy": OrderedDict([("a.b", torch.ones(2)), ("c", torch.ones(()))]), "n": [1, 0.5]}
    tree |= {"none": None, "word": "nan", "generator": torch.zeros(3, dtype=torch.uint8)}
    assert nonfinite_leaf(tree) is None
    assert nonfinite_leaf({**tree, "n": [1, torch.inf]}) == "n.1"
    tree["policy"]["a.b"][1] = torch.nan
    assert nonfinite_leaf(tree) == "policy.a.b"


@pytest.mark.cuda
def test_looking_over_a_rollout_never_synchronises():
    rollout = {name: values.cuda() for name, values in numbers().items()}
    rollout["obs.imu"][3, 1] = torch.nan
    check = NonFiniteCheck(torch.device("cuda"))
    check(rollout)
    torch.cuda.set_sync_debug_mode("error")
    try:
        is_fine = check(rollout)
        check.count(~is_fine)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    bad, n_skipped = check.read(rollout)
    assert (bad.name, bad.lane, bad.step, n_skipped) == ("obs.imu", 1, 4, 1)
