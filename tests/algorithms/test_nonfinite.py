"""Detection of non-finite numbers in rollouts and in saved state."""

import math
from collections import OrderedDict

import pytest
import torch

from megastep.agents.algorithms import nonfinite
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
    # the third row of the second rollout: the world after T + 2 steps, or the step after that
    step = T + 3 if len(rollout[name]) == T else T + 2
    assert (bad.name, bad.lane, bad.step) == (name, 1, step)
    assert not bad.size <= LIMIT and name in str(bad)
    if name != "obs.rgb":  # which overflows
        assert bad.size == pytest.approx(abs(value), nan_ok=True)


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
    assert check.read(good)[0].step == 4 * T


def test_first_of_many_lanes_is_named_and_the_others_counted():
    """Lane 19 is bad first, 2 to 11 follow, 0 later. Each has several numbers."""
    floats = {"obs": torch.zeros(T + 1, 20, 1, 2), "reward": torch.zeros(T, 20)}
    floats["obs"][3:, 19] = floats["reward"][1:, 19] = torch.nan
    floats["obs"][3:, 2:12], floats["reward"][3:, 0] = torch.inf, 1e13
    check = NonFiniteCheck("cpu")
    check(floats)
    value, _ = check.read(floats)
    assert str(value) == "reward of lane 19 was nan at step 2; and so for 11 more lanes"
    in_env = value.in_env(range(100, 120), n_agents=2)
    assert str(in_env).startswith("reward of lane 119 (environment 59) was nan at step 2")
    assert check.read(floats) == (None, 0)


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
    assert nonfinite_leaf({**tree, "best": -torch.inf}) is None
    assert nonfinite_leaf({**tree, "n": [1, torch.tensor(torch.inf)]}) == "n.1"
    tree["policy"]["a.b"][1] = torch.nan
    assert nonfinite_leaf(tree) == "policy.a.b"


def bad_rollout(seed, n_lanes, n_bad, value, extra_row, to_gpu=torch.Tensor.cuda):
    """Returns floats on a GPU. Some numbers of some lanes are bad, others large but allowed.

    Args:
        n_bad: bad numbers per tensor, at random places; the second of imu at its end.
        value: the bad number, which may overflow in float16.
        extra_row: whether observations have T + 1 rows.
    """
    generator = torch.Generator().manual_seed(seed)
    n_rows = T + extra_row
    shapes = dict(
        rgb=((n_rows, n_lanes, 1, 3, 1, 8), torch.float16),  # read in words of eight
        imu=((n_rows, n_lanes, 1, 3), torch.float16),
        unseen=((n_rows, n_lanes, 1, 48), torch.float32),
        reward=((T, n_lanes), torch.float32),
        short=((T, n_lanes), torch.float16),
        value=((n_rows, n_lanes), torch.float32),
    )
    floats = {}
    for name, (shape, dtype) in shapes.items():
        leaf = torch.rand(shape, generator=generator).to(dtype)
        leaf.view(-1)[::7] = 0.99 * LIMIT if dtype == torch.float32 else 65_504.0
        places = torch.randint(leaf.numel(), (n_bad,), generator=generator)
        if name == "imu":
            places[1:2] = leaf.numel() - 1  # not in a whole word
        leaf.view(-1)[places] = torch.tensor(value).to(dtype)
        floats[name] = to_gpu(leaf)
    return floats


@pytest.mark.parametrize(
    "n_lanes, n_bad, value",
    [
        *((3, 2, value) for value in (torch.nan, torch.inf, -torch.inf, 1.01 * LIMIT, -1e30)),
        *((1, 1, torch.nan), (41, 2, 1.01 * LIMIT), (1100, 700, torch.nan)),
    ],
)
@pytest.mark.parametrize("extra_row", [False, True])
def test_kernels_find_what_the_plain_form_finds(
    to_gpu, monkeypatch, n_lanes, n_bad, value, extra_row
):
    """Among many rollouts: the first bad one is kept until it is read."""
    good, first, second = (
        bad_rollout(seed, n_lanes, n, value, extra_row, to_gpu)
        for seed, n in enumerate((0, n_bad, 2 * n_bad))
    )
    assert nonfinite._are_readable(good)
    results = []
    for is_fused in (True, False):
        if not is_fused:
            monkeypatch.setattr(nonfinite, "_are_readable", lambda floats: False)
        check, texts = NonFiniteCheck(good["rgb"].device), []
        for rollout in (good, first, second, good, None, second, good, None, first, None):
            if rollout is None:
                bad, _ = check.read(good)
                texts.append(repr(bad))
            else:
                texts.append(bool(check(rollout)))
            texts.append(bool(check.record[2] > 0))
        results.append((texts, check.state_dict().tolist()))
    assert results[0] == results[1]
    texts = results[0][0]
    assert texts[:4] == [True, False, False, True] and "NonFiniteValue" in texts[8]


def test_infinities_of_both_signs_are_found(to_gpu):
    """Kernels and plain form add a row's float16 numbers up, which makes NaN of them."""
    rollout = bad_rollout(0, 3, 0, 0.0, True, to_gpu)
    rollout["rgb"][2, 1].view(-1)[:2] = to_gpu(torch.tensor([torch.inf, -torch.inf]))
    check = NonFiniteCheck(rollout["rgb"].device)
    assert not check(rollout)
    value = check.read(rollout)[0]
    assert (value.name, value.lane, value.step) == ("rgb", 1, 2) and math.isnan(value.size)
