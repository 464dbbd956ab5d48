"""Means of episodes with their confidence intervals."""

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from megastep.agents.types import Row
from megastep.arrdict import arrdict, numpyify

#: How an episode ended: terminal or truncated, as the environment said, or cut off at the limit of
#: steps.
ENDS = "cut off", "truncated", "terminal"
#: What tells how well an episode went, the first that there is; homes of all sizes compare by it.
SCORES = "success", "coverage", "won", "return"
BOUNDS = "mean", "lower", "upper"


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
    """Returns the mean of values (B,) and its bootstrap interval: `(mean, lower, upper)`.

    Lanes in the same home are correlated, so whole groups are resampled (the cluster bootstrap;
    Efron and Tibshirani, An Introduction to the Bootstrap, 1993, section 13.3). Each resample's
    estimate is the mean over its lanes, so larger groups weigh more.

    Args:
        groups: (B,) integers, the home of each lane. None or one: lanes are resampled.
    """
    values = np.asarray(values, float)
    if groups is None or len(np.unique(groups)) == 1:
        groups = np.arange(len(values))
    _, groups = np.unique(groups, return_inverse=True)
    sums, counts = np.bincount(groups, values), np.bincount(groups)
    drawn = resamples(len(sums), n_resamples, seed)
    lower, upper = bounds(sums[drawn].sum(1) / counts[drawn].sum(1), level)
    return float(values.mean()), float(lower), float(upper)


def _counted(played) -> np.ndarray:
    """Returns the lanes that learn, or all lanes if none does; all duels."""
    if "score" in played:
        return np.ones(len(played["score"]), bool)
    return played["learns"] if played["learns"].any() else ~played["learns"]


def summaries(
    played: Mapping, roles: Sequence[str] | None = None, sources: Sequence[str] | None = None
) -> list[Row]:
    """Returns the table rows of the result of `first_episodes` or `first_duels`: one overall, then
    one per role and one per source of homes.

    Of episodes only lanes that learn are counted, or all lanes if none learns. An episode whose
    metric is not finite is left out of that metric; a warning names the metric. Of duels, `won` is
    the fraction won, a draw counting half, and a role's row has those in which `policy` played it.
    Intervals, `lower` to `upper`, are over homes, or over environments if there are no homes.

    Args:
        roles: the role of each agent slot, repeated over environments.
        sources: the source of each home.
    """
    played = numpyify(played)
    counted, homes = _counted(played), played.get("homes")
    for name, values in played.get("metrics", {}).items():
        finished = values[counted & played["done"]]
        if n_left_out := int((~np.isfinite(finished)).sum()):
            warnings.warn(
                f"metrics.{name} was not finite at the end of {n_left_out:,} of "
                f"{len(finished):,} episodes, which are left out of its mean",
                stacklevel=2,
            )
    rows, slots = [_summary(played, counted)], played.get("slots", np.arange(len(counted)))
    parts: list[tuple] = []
    if roles:
        parts.append(("role", np.array(roles)[slots % len(roles)], roles))
    if homes is not None and sources is not None:
        parts.append(("source", np.array(sources)[homes], sources))
    for key, part_of, names in parts:
        for name in dict.fromkeys(names):
            if (lanes := counted & (part_of == name)).any():
                rows.append({key: name, **_summary(played, lanes)})
    return rows


def _summary(played, lanes) -> Row:
    homes, length = played.get("homes"), float(played["lengths"][lanes].mean())
    n_homes = None if homes is None else len(np.unique(homes[lanes]))
    if "score" in played:
        score = played["score"][lanes]
        return {
            **_interval("won", score, None if homes is None else homes[lanes]),
            "wins": int((score == 1).sum()),
            "losses": int((score == 0).sum()),
            "draws": int(((score != 1) & (score != 0)).sum()),
            "length": length,
            "duels": len(score),
            "homes": n_homes,
        }
    done = played["done"][lanes]
    # agents of one environment are one sample
    groups = played["envs" if n_homes in (None, 1) else "homes"][lanes]
    metrics = {}
    for name, values in played["metrics"].items():
        values = values[lanes][done]
        is_finite, metrics[name] = np.isfinite(values), dict.fromkeys(BOUNDS)
        if is_finite.any():
            metrics[name] = _interval("mean", values[is_finite], groups[done][is_finite])
    return {
        **_interval("return", played["returns"][lanes], groups),
        "length": length,
        "lanes": int(lanes.sum()),
        "homes": n_homes,
        "unfinished": int((~done).sum()),
        "metrics": metrics,
    }


def _interval(name, values, groups) -> dict[str, float]:
    return dict(zip((name, *BOUNDS[1:]), interval(values, groups), strict=True))


def difference(played: Mapping, other: Mapping) -> arrdict:
    """Returns the episodes of one player less those of another that began alike, as pairs."""
    both = _counted(played) & _counted(other)
    pairs = arrdict(played, done=played["done"] & other["done"], learns=both)
    for name in ("returns", "lengths", "metrics"):
        pairs[name] = played[name] - other[name]
    return pairs


def rows_of(
    episodes: Mapping,
    seed: int,
    numbers: Sequence[int],
    sources: Sequence[str] | None = None,
    roles: Sequence[str] | None = None,
) -> list[Row]:
    """Returns a dict per episode of the result of `first_episodes`, of the lanes that count:

    - episode: the number of the lane; seed: of the evaluation
    - home, source: its number in the split, and the source it is from
    - role: of the agent
    - start_x, start_y, start_angle: where the agent was put, metres and degrees
    - return, length (steps), and each metric by its name, None if it is not finite
    - ended: one of `ENDS`

    Args:
        numbers: the number of each home in the split.
        sources, roles: as for `summaries`.
    """
    played = numpyify(episodes)
    lanes = np.flatnonzero(_counted(played))
    columns = {"episode": lanes.tolist(), "seed": [seed] * len(lanes)}
    if "homes" in played:
        homes = played["homes"][lanes].tolist()
        columns["home"] = [numbers[home] for home in homes]
        columns |= {"source": [sources[home] for home in homes]} if sources else {}
    if roles:
        columns["role"] = [roles[lane % len(roles)] for lane in lanes]
    if "starts" in played:
        names = "start_x", "start_y", "start_angle"
        columns |= dict(zip(names, played["starts"][lanes].T.tolist(), strict=True))
    columns["return"] = played["returns"][lanes].tolist()
    columns["length"] = played["lengths"][lanes].astype(int).tolist()
    ended = played["done"][lanes].astype(int) + played["terminal"][lanes]
    columns["ended"] = [ENDS[how] for how in ended]
    for name, values in played["metrics"].items():
        finite = [x if np.isfinite(x) else None for x in values[lanes].tolist()]
        columns[name + "_" * (name in columns)] = finite
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
