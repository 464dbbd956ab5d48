"""Statistics over the seeds of runs: interquartile means, intervals, performance profiles, curves.

As Agarwal et al. define them (Deep Reinforcement Learning at the Edge of the Statistical Precipice,
NeurIPS 2021), whose library is rliable. A task is an environment in its homes.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from megastep.agents.evaluation.statistics import bounds, resamples


def iqm(scores: ArrayLike) -> float:
    """Returns the interquartile mean: of the middle half of all scores, of any shape. A quarter of
    them, rounded down, is left out at either end.
    """
    ordered = np.sort(np.asarray(scores, float), axis=None)
    n_cut = len(ordered) // 4
    return float(ordered[n_cut : len(ordered) - n_cut].mean())


def interval(
    scores: Sequence[ArrayLike],
    statistic: Callable[[np.ndarray], float] = iqm,
    level: float = 0.95,
    n_resamples: int = 2000,
    seed: int = 1,
) -> tuple[float, float, float]:
    """Returns a statistic of all tasks' scores and its stratified bootstrap interval:
    `(value, lower, upper)`. The runs of each task are resampled by themselves.

    Args:
        scores: of each task, those of its runs.
    """
    tasks = [np.asarray(task, float) for task in scores]
    draw = np.random.default_rng(seed)
    resampled = []
    for _ in range(n_resamples):
        drawn = [task[draw.integers(len(task), size=len(task))] for task in tasks]
        resampled.append(statistic(np.concatenate(drawn)))
    lower, upper = bounds(resampled, level)
    return statistic(np.concatenate(tasks)), float(lower), float(upper)


#: The head of the table of `pooled`, with the name of a metric to fill in.
POOLED = ["runs", "seeds", "IQM of {}", "95 % interval"]


def pooled(scores: Mapping[str, Sequence[float]]) -> list[list[str]]:
    """Returns a row for each label: the number of seeds, the IQM of their scores, its interval."""
    rows = []
    for name, values in scores.items():
        middle, lower, upper = interval([values]) if len(values) else 3 * (float("nan"),)
        rows.append([name, str(len(values)), f"{middle:.4g}", f"{lower:.4g} to {upper:.4g}"])
    return rows


def profile(scores: Sequence[ArrayLike], thresholds: ArrayLike) -> np.ndarray:
    """Returns the performance profile, (K,): the fraction of runs whose score exceeds each of K
    thresholds, averaged over tasks.
    """
    limits = np.asarray(thresholds, float)[:, None]
    return np.mean([(np.asarray(task, float) > limits).mean(1) for task in scores], 0)


def band(
    curves: Sequence[tuple[ArrayLike, ArrayLike]],
    n_points: int = 200,
    level: float = 0.95,
    n_resamples: int = 500,
    seed: int = 1,
) -> dict[str, np.ndarray]:
    """Returns the mean curve of several seeds with its bootstrap interval: {x, mean, lower, upper},
    (n_points,) each. Curves, `(x, y)` of each seed, are interpolated where all have points.
    """
    start = max(np.min(x) for x, _ in curves)
    end = max(start, min(np.max(x) for x, _ in curves))
    x = np.linspace(start, end, n_points)
    values = np.stack([np.interp(x, np.asarray(at), np.asarray(y)) for at, y in curves])
    means = values[resamples(len(curves), n_resamples, seed)].mean(1)
    lower, upper = bounds(means, level, axis=0)
    return {"x": x, "mean": values.mean(0), "lower": lower, "upper": upper}
