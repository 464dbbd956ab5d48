"""Statistics over the seeds of runs: interquartile means, intervals, performance profiles, curves.

As Agarwal et al. define them (Deep Reinforcement Learning at the Edge of the Statistical Precipice,
NeurIPS 2021), whose library is rliable. A task is an environment in its homes.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from megastep.agents.evaluation.statistics import bounds, resamples


def iqm(scores: ArrayLike) -> float:
    """Returns the interquartile mean, of the middle half of all scores, of any shape."""
    return float(stats.trim_mean(np.ravel(scores), 0.25))


def interval(
    scores: Sequence[ArrayLike], statistic: Callable[[np.ndarray], float] = iqm, level: float = 0.95
) -> tuple[float, float, float]:
    """Returns a statistic of all tasks' scores and its stratified bootstrap interval:
    `(value, lower, upper)`. The runs of each task are resampled by themselves.

    Args:
        scores: of each task, those of its runs. The bounds are NaN if each task has only one.
    """
    tasks = [np.asarray(task, float) for task in scores]
    if max(map(len, tasks)) < 2:
        return statistic(np.concatenate(tasks)), math.nan, math.nan
    drawn = [task[resamples(len(task), seed=i)] for i, task in enumerate(tasks)]
    lower, upper = bounds([*map(statistic, np.concatenate(drawn, 1))], level)
    return statistic(np.concatenate(tasks)), float(lower), float(upper)


#: The head of the table of `pooled`, with the name of a metric to fill in.
POOLED = ["runs", "seeds", "IQM of {}", "95 % interval"]


def pooled(scores: Mapping[str, Sequence[float]]) -> list[list[str]]:
    """Returns a row for each label: the number of seeds, the IQM of their scores, its interval."""
    rows = []
    for name, values in scores.items():
        middle, lower, upper = interval([values]) if len(values) else 3 * (float("nan"),)
        bounds_text = "none" if math.isnan(lower) else f"{lower:.4g} to {upper:.4g}"
        rows.append([name, str(len(values)), f"{middle:.4g}", bounds_text])
    return rows


def profile(scores: Sequence[ArrayLike], thresholds: ArrayLike) -> np.ndarray:
    """Returns the fraction of runs above each of K thresholds, averaged over tasks, (K,)."""
    limits = np.asarray(thresholds, float)[:, None]
    return np.mean([(np.asarray(task, float) > limits).mean(1) for task in scores], 0)


def band(
    curves: Sequence[tuple[ArrayLike, ArrayLike]], n_points: int = 200, level: float = 0.95
) -> dict[str, np.ndarray]:
    """Returns the mean curve of several seeds with its bootstrap interval: {x, mean, lower, upper},
    (n_points,) each. Curves, `(x, y)` of each seed, are interpolated from where all have points to
    the end of the longest, a point over the curves that reach it; of one alone the bounds are NaN.
    """
    curves = sorted(curves, key=lambda curve: -np.max(curve[0]))
    start = max(np.min(x) for x, _ in curves)
    x = np.linspace(start, max(start, np.max(curves[0][0])), n_points)
    values = np.stack([np.interp(x, np.asarray(at), np.asarray(y)) for at, y in curves])
    n_there = np.maximum(1, np.sum([x <= np.max(at) for at, _ in curves], 0))
    mean, lower, upper = np.full((3, n_points), np.nan)
    for n in {*n_there.tolist()}:  # the longest n
        of_n, at = values[:n, n_there == n], n_there == n
        mean[at] = of_n.mean(0)
        if n > 1:
            lower[at], upper[at] = bounds(of_n[resamples(n, 500)].mean(1), level, axis=0)
    return {"x": x, "mean": mean, "lower": lower, "upper": upper}
