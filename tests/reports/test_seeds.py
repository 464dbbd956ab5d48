"""Statistics over seeds, by hand and beside another program's."""

import numpy as np

from megastep.agents.reports import seeds


def test_tasks_are_resampled_by_themselves():
    """Each resample has every task, so tasks without spread have an interval without width."""
    assert seeds.interval([[1.0] * 4, [3.0] * 4], np.mean) == (2, 2, 2)
    value, lower, upper = seeds.interval([[0.0, 1] * 50])
    assert value == 0.5 and 0 <= lower < 0.5 < upper <= 1


def test_band_begins_where_all_seeds_have_points_and_goes_on_to_the_longest():
    curves = ([0, 10, 20], [0.0, 10, 20]), ([10, 30], [30.0, 50])
    one = seeds.band(curves, n_points=3)
    assert one["x"].tolist() == [10, 20, 30] and one["mean"].tolist() == [20, 30, 50]
    assert (one["lower"] <= one["mean"])[:2].all() and one["upper"][:2].tolist() == [30, 40]
    alone = seeds.band(curves[:1], n_points=2)
    assert alone["mean"].tolist() == [0, 20]
    # one seed has no interval
    bounds = [one["lower"][2], one["upper"][2], *alone["lower"], *alone["upper"]]
    assert np.isnan([*bounds, *seeds.interval([[3.0], [1.0]])[1:]]).all()
    assert seeds.pooled({"a": [3.0]}) == [["a", "1", "3", "none"]]
