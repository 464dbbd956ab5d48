"""Means of episodes with their confidence intervals, overall and in the worst homes."""

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from megastep.agents.types import Row


def resamples(n: int, n_resamples: int = 2000, seed: int = 1) -> np.ndarray:
    """Returns indices for a bootstrap, (n_resamples, n): each row draws n of n with replacement."""
    return np.random.default_rng(seed).integers(n, size=(n_resamples, n))


def bounds(
    resampled: np.ndarray | list[float], level: float = 0.95, axis: int | None = None
) -> np.ndarray:
    """Returns the lower and upper bound of a percentile bootstrap; NaN is left out."""
    return np.nanquantile(resampled, [(1 - level) / 2, (1 + level) / 2], axis=axis)


def interval(
    values: ArrayLike,
    groups: ArrayLike | None = None,
    level: float = 0.95,
    n_resamples: int = 2000,
    seed: int = 1,
) -> tuple[float, float, float]:
    """Returns a mean and its bootstrap confidence interval: `(mean, lower, upper)`.

    Lanes in the same home are correlated, so whole groups are resampled (the cluster bootstrap;
    Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 13.3). Each resample's
    estimate is the mean over its lanes, so larger groups weigh more.

    Args:
        values: (B,).
        groups: (B,) integers, the home of each lane. Lanes are resampled if there is no group or
            only one.
        level: probability that the interval covers the mean.
    """
    values = np.asarray(values, float)
    if groups is None or len(np.unique(groups)) == 1:
        groups = np.arange(len(values))
    _, groups = np.unique(groups, return_inverse=True)
    sums, counts = np.bincount(groups, values), np.bincount(groups)
    drawn = resamples(len(sums), n_resamples, seed)
    lower, upper = bounds(sums[drawn].sum(1) / counts[drawn].sum(1), level)
    return float(values.mean()), float(lower), float(upper)


def lanes_by_source(
    homes: np.ndarray | None, sources: Sequence[str] | None
) -> dict[str, np.ndarray]:
    """Returns {source: (B,) bool, the lanes that played in its homes}; empty if nothing is known.

    Args:
        homes: (B,) integers, the home of each lane.
        sources: the source of each home.
    """
    if homes is None or sources is None:
        return {}
    source_of_lane = np.array(sources)[homes]
    lanes = {source: source_of_lane == source for source in dict.fromkeys(sources)}
    return {source: played for source, played in lanes.items() if played.any()}


#: How an episode ended: terminal or truncated, as the environment said, or cut off at the limit of
#: steps.
ENDS = "cut off", "truncated", "terminal"
#: What tells how well an episode went, the first that there is; homes of all sizes compare by it.
SCORES = "success", "coverage", "won", "return"


TAIL = 0.05  # fraction of homes that `worst_homes` averages


def score_of(row: Mapping) -> float:
    """Returns the mean of the first of `SCORES` that a table row has."""
    values = {k: row[k] for k in ("won", "return") if k in row}
    values |= {name: metric["mean"] for name, metric in row.get("metrics", {}).items()}
    return next(values[name] for name in SCORES if values.get(name) is not None)


def worst_homes(
    columns: Mapping[str, ArrayLike],
    homes: ArrayLike,
    level: float = 0.95,
    n_resamples: int = 2000,
    seed: int = 1,
) -> tuple[np.ndarray, dict[str, dict[str, float]]]:
    """Returns the worst `TAIL` of all homes, and the means of `columns` in them.

    Homes are ordered by the mean, over their episodes, of the first of `SCORES` among the columns;
    in the worst, that mean is the conditional value at risk (CVaR; Rockafellar and Uryasev 2000).
    Intervals are from resampling homes, of which the worst are taken anew.

    Args:
        columns: name -> (B,). What is not finite is left out of a home's mean.
        homes: (B,) integers, the home of each episode.

    Returns:
        The numbers of the homes, and {name: {mean, lower, upper}}, None for each if no episode in
        them has a number.
    """
    numbers, homes = np.unique(np.asarray(homes), return_inverse=True)
    means = {name: _means_by_home(np.asarray(v, float), homes) for name, v in columns.items()}
    # of homes with equal scores, those that do worse by the next score come first
    order = np.lexsort([means[name] for name in reversed(SCORES) if name in means])
    n_worst, n_homes = max(1, round(TAIL * len(numbers))), len(numbers)
    drawn = resamples(n_homes, n_resamples, seed)
    worst = order[np.sort(order.argsort()[drawn], 1)[:, :n_worst]]
    result = {}
    for name, by_home in means.items():
        mean, resampled = _finite_mean(by_home[order[:n_worst]]), _finite_mean(by_home[worst])
        numbers_in_worst = [None] * 3
        if np.isfinite(mean):
            numbers_in_worst = [float(mean), *bounds(resampled, level).tolist()]
        result[name] = dict(zip(("mean", "lower", "upper"), numbers_in_worst, strict=True))
    return numbers[order[:n_worst]], result


def _finite_mean(values) -> np.ndarray:
    """Returns the mean over the last axis of what is finite, nan if there is none."""
    is_finite = np.isfinite(values)
    counts = is_finite.sum(-1)
    means = np.where(is_finite, values, 0.0).sum(-1) / np.maximum(counts, 1)
    return np.where(counts > 0, means, np.nan)


def _means_by_home(values, homes) -> np.ndarray:
    """Returns the mean of each home's finite values, nan if there is none."""
    is_finite = np.isfinite(values)
    counts = np.bincount(homes[is_finite], minlength=homes.max() + 1)
    sums = np.bincount(homes[is_finite], values[is_finite], len(counts))
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def worst_summary(episodes: Mapping) -> "Row":
    """Returns a table row of the worst homes, `worst_homes`, from the result of `first_episodes`.

    A metric without a number in them is left out. Unfinished episodes are not counted.
    """
    learns, done, homes = (episodes[k].cpu().numpy() for k in ("learns", "done", "homes"))
    lanes = (learns if learns.any() else ~learns) & done
    columns = dict(episodes["metrics"], length=episodes["lengths"])
    columns["return"] = episodes["returns"]
    columns = {name: values.cpu().numpy()[lanes] for name, values in columns.items()}
    columns = {name: values for name, values in columns.items() if np.isfinite(values).any()}
    numbers, means = worst_homes(columns, homes[lanes])
    length, of_return = means.pop("length")["mean"], means.pop("return")
    return {
        "return": of_return["mean"],
        "lower": of_return["lower"],
        "upper": of_return["upper"],
        "length": length,
        "lanes": int(np.isin(homes[lanes], numbers).sum()),
        "homes": len(numbers),
        "unfinished": 0,
        "metrics": means,
    }


def summaries(
    episodes: Mapping, roles: Sequence[str] | None = None, sources: Sequence[str] | None = None
) -> "list[Row]":
    """Returns table rows for the result of `first_episodes`: one overall, then one per role and one
    per source of homes.

    Only lanes that learn are counted, or all lanes if none learns. An episode whose metric is not
    finite is left out of that metric; a warning names the metric.

    Args:
        roles: the role of each agent slot, repeated over environments.
        sources: the source of each home.
    """
    learns = episodes["learns"].cpu().numpy()
    learns = learns if learns.any() else ~learns
    is_counted = learns & episodes["done"].cpu().numpy()
    for name, values in episodes["metrics"].items():
        if n_left_out := int((~np.isfinite(values.cpu().numpy()[is_counted])).sum()):
            warnings.warn(
                f"metrics.{name} was not finite at the end of {n_left_out:,} of "
                f"{is_counted.sum():,} episodes, which are left out of its mean",
                stacklevel=2,
            )
    rows = [_summary(episodes, learns)]
    role_of_lane = np.resize(np.array(roles or ()), len(learns))
    for role in dict.fromkeys(roles or ()):
        if (lanes := learns & (role_of_lane == role)).any():
            rows.append({"role": role, **_summary(episodes, lanes)})
    homes = episodes["homes"].cpu().numpy() if "homes" in episodes else None
    for source, lanes in lanes_by_source(homes, sources).items():
        if (lanes := learns & lanes).any():
            rows.append({"source": source, **_summary(episodes, lanes)})
    return rows


def _summary(episodes, lanes) -> "Row":
    """Returns a table row for some lanes, (B,) bool.

    Intervals are over homes, or over environments if there are no homes or only one.
    """
    keys = [key for key in ("returns", "lengths", "done", "envs", "homes") if key in episodes]
    arrays = {key: episodes[key].cpu().numpy()[lanes] for key in keys}
    homes, done = arrays.get("homes"), arrays["done"]
    groups = arrays["envs"] if homes is None or len(np.unique(homes)) == 1 else homes
    mean, lower, upper = interval(arrays["returns"], groups)
    return {
        "return": mean,
        "lower": lower,
        "upper": upper,
        "length": float(arrays["lengths"].mean()),
        "lanes": int(lanes.sum()),
        "homes": None if homes is None else len(np.unique(homes)),
        "unfinished": int((~done).sum()),
        "metrics": {
            name: _metric(values.cpu().numpy()[lanes][done], groups[done])
            for name, values in episodes["metrics"].items()
        },
    }


def _metric(values, groups) -> dict[str, float | None]:
    """Returns the mean of finite values with its 95 % interval by name; None for each if there are
    none.
    """
    is_finite = np.isfinite(values)
    values, groups = values[is_finite], groups[is_finite]
    numbers = interval(values, groups) if len(values) else (None,) * 3
    return dict(zip(("mean", "lower", "upper"), numbers, strict=True))


def rows_of(
    played: Mapping,
    seed: int,
    numbers: Sequence[int] | None = None,
    sources: Sequence[str] | None = None,
    roles: Sequence[str] | None = None,
) -> "list[Row]":
    """Returns a dict per episode for the result of `playing.first_episodes`.

    Only lanes that learn have one, or all lanes if none learns, as in `summaries`. Keys,
    those of what is known:

    - episode: the number of the lane; seed: of the evaluation
    - home, source: its number in the split, and the source it is from
    - role: of the agent
    - start_x, start_y, start_angle: where the agent was put, metres and degrees
    - return, length (steps), and each metric by its name, None if it is not finite
    - ended: terminal, truncated, or cut off at the limit of steps

    Args:
        numbers: the number of each home in the split; by default its index.
        sources: the source of each home.
        roles: the role of each agent slot, repeated over environments.
    """
    arrays = {k: v.cpu().numpy() for k, v in played.items() if isinstance(v, torch.Tensor)}
    learns = arrays["learns"]
    lanes = np.flatnonzero(learns if learns.any() else ~learns)
    columns = {"episode": lanes.tolist(), "seed": [seed] * len(lanes)}
    if (homes := arrays.get("homes")) is not None:
        known = homes[lanes].tolist()
        columns["home"] = [home if numbers is None else numbers[home] for home in known]
        columns |= {"source": [sources[home] for home in known]} if sources else {}
    if roles:
        columns["role"] = [roles[lane % len(roles)] for lane in lanes]
    if (starts := arrays.get("starts")) is not None:
        names = "start_x", "start_y", "start_angle"
        columns |= dict(zip(names, starts[lanes].T.tolist(), strict=True))
    columns["return"] = arrays["returns"][lanes].tolist()
    columns["length"] = arrays["lengths"][lanes].astype(int).tolist()
    ended = arrays["done"][lanes].astype(int) + arrays["terminal"][lanes]
    columns["ended"] = [ENDS[how] for how in ended]
    for name, values in played["metrics"].items():
        finite = [x if np.isfinite(x) else None for x in values.cpu().numpy()[lanes].tolist()]
        columns[name + "_" * (name in columns)] = finite
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
