"""PopArt: updating the statistics of returns keeps the predictions."""

import math

import pytest
import torch

from megastep.agents.networks.value_output import ValueOutput
from tests.helpers.weights import moved

WIDTH, VALID = 24, torch.ones(64, dtype=torch.bool)


def test_update_stats_keeps_predictions():
    value, x = ValueOutput(WIDTH), torch.randn(200, WIDTH)
    before = value(x)
    for offset in (0.0, 300.0, 310.0):
        value.update_stats(torch.randn(64) * 20 + offset, VALID)
        assert value.mean.item() != 0 and value.scale.item() != 1
        # float32 at a mean of 300
        torch.testing.assert_close(value(x), before, rtol=1e-4, atol=1e-4)


def test_statistics_of_valid_returns():
    value = ValueOutput(WIDTH)
    value.update_stats(torch.tensor([1.0, 5.0, torch.nan]), torch.tensor([True, True, False]))
    assert value.mean.item() == pytest.approx(3) and value.scale.item() == pytest.approx(2)
    value.update_stats(torch.full((64,), 9.0), VALID)
    # the second call has weight 1/2: mean 6, mean square (13 + 81) / 2 = 47, standard deviation
    # sqrt(47 - 36)
    assert value.mean.item() == pytest.approx(6) and value.scale.item() == pytest.approx(11**0.5)
    value.update_stats(torch.full((64,), 7.0), ~VALID)
    assert value.mean.item() == pytest.approx(6) and value.scale.item() == pytest.approx(11**0.5)


def test_constant_returns_do_not_divide_by_zero():
    value = ValueOutput(WIDTH)
    value.update_stats(torch.ones(64), VALID)
    assert value.scale.item() == pytest.approx(1e-5) and value.count == 1
    for _ in range(3000):
        value.update_stats(torch.zeros(64), VALID)
    assert 0 < value.scale.item() < 1e-12
    assert value(torch.randn(8, WIDTH)).isfinite().all()


def test_returns_of_0_tell_nothing_before_there_are_others():
    value = ValueOutput(WIDTH)
    value.update_stats(torch.zeros(64), VALID)
    assert value.count == 0 and value.scale == 1
    value.update_stats(torch.tensor([1e-9, 3e-9] * 32), VALID)
    assert value.count == 1 and value.scale.item() == pytest.approx(1e-9)


def test_cleared_output_predicts_0_until_returns_tell_their_size():
    value, x = ValueOutput(WIDTH), torch.randn(8, WIDTH)
    value.clear()
    assert value.is_clear and not value(x).any()
    value.update_stats(torch.randn(64) * 1e5 + 1e6, VALID)
    assert not value.is_clear and value(x).abs().max() < 1  # float32 at a mean of 1e6
    before = value.linear.bias.item()
    value.clear()
    assert value.linear.bias.item() == before != 0


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e30])
def test_nonfinite_returns_change_nothing(bad):
    value = ValueOutput(WIDTH)
    value.update_stats(torch.randn(64) * 3 + 1, VALID)
    before = {name: tensor.clone() for name, tensor in value.state_dict().items()}
    # 1e30 is finite, its square is not
    value.update_stats(torch.tensor([1.0, 2.0, bad]), torch.tensor([True, True, True]))
    assert all(torch.equal(value.state_dict()[name], before[name]) for name in before)


def test_a_gpu_adds_the_same_moments(to_gpu):
    """Also none, those that do not count, and those that are not finite."""
    width, yes = 300, torch.tensor(True)
    one = ValueOutput(width)
    other = moved(one, to_gpu)
    calls = [(5, 3.0, 4.0, None), (5, 30.0, 400.0, yes), (0, 1.0, 1.0, yes), (4, 8.0, 9.0, ~yes)]
    calls += [(5, math.nan, 1.0, None), (5, 1.0, math.inf, None), (4, 9.0, 0.0, yes)]
    calls = [(5, 0.0, 0.0, yes), *calls]
    for *moments, is_counted in calls:
        moments = [torch.tensor(number) for number in moments]
        one.add(moments, is_counted)
        on_gpu = None if is_counted is None else to_gpu(is_counted)
        other.add([to_gpu(number) for number in moments], on_gpu)
        for name, tensor in one.state_dict().items():
            close = dict(rtol=1e-5, atol=1e-6)
            torch.testing.assert_close(other.state_dict()[name].cpu(), tensor, **close)
    assert one.count == 3
