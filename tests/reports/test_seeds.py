"""Statistics over seeds, by hand and beside another program's."""

import numpy as np
import pytest

from megastep.agents.reports import seeds


def test_interquartile_mean_by_hand():
    """Of eight scores the two lowest and the two highest are left out; of three, none."""
    scores = [[100.0, 1, 2, 3], [4, -50, 5, 6]]  # in order: -50, 1, | 2, 3, 4, 5, | 6, 100
    assert seeds.iqm(scores) == 3.5
    assert seeds.iqm([1, 2, 9]) == 4


@pytest.mark.parametrize("n", [1, 4, 7, 30])
def test_interquartile_mean_is_that_of_scipy(n):
    stats = pytest.importorskip("scipy.stats")
    scores = np.random.default_rng(n).normal(size=(n, 3))
    assert seeds.iqm(scores) == pytest.approx(stats.trim_mean(scores, 0.25, axis=None))


def test_tasks_are_resampled_by_themselves():
    """Each resample has every task, so tasks without spread have an interval without width."""
    assert seeds.interval([[1.0] * 4, [3.0] * 4], np.mean) == (2, 2, 2)
    value, lower, upper = seeds.interval([[0.0, 1] * 50])
    assert value == 0.5 and 0 <= lower < 0.5 < upper <= 1


def test_interval_covers_the_mean_as_often_as_it_says():
    draw = np.random.default_rng(1)
    bounds = [
        seeds.interval([draw.normal(size=40)], np.mean, n_resamples=200, seed=i)[1:]
        for i in range(200)
    ]
    covered = np.mean([lower < 0 < upper for lower, upper in bounds])
    assert 0.88 < covered < 0.99


def test_profile_by_hand():
    """Of the first task's two runs one exceeds 0.5, of the second's four, three."""
    scores = [[0.2, 0.9], [0.6, 0.5, 0.7, 0.8]]
    assert seeds.profile(scores, [0, 0.5, 1]).tolist() == [1, (1 / 2 + 3 / 4) / 2, 0]


def test_band_is_where_all_seeds_have_points():
    curves = ([0, 10, 20], [0.0, 10, 20]), ([10, 30], [30.0, 50])
    one = seeds.band(curves, n_points=3)
    assert one["x"].tolist() == [10, 15, 20] and one["mean"].tolist() == [20, 25, 30]
    assert (one["lower"] <= one["mean"]).all() and one["upper"].tolist() == [30, 35, 40]
    alone = seeds.band(curves[:1], n_points=2)
    assert alone["lower"].tolist() == alone["upper"].tolist() == alone["mean"].tolist() == [0, 20]
