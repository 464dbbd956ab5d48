"""Evaluation of a policy: the first episode of every lane, with confidence intervals.

Axes: B lanes, N environments. The host synchronises with the device every `CHECK_EVERY` steps.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch.utils import _pytree

from megastep import spaces
from megastep.agents.generator import SeededGenerator
from megastep.agents.storage.collector import capture_with
from megastep.arrdict import arrdict
from megastep.types import Env, Policy, Space, Tree, World, n_lanes, optional

#: Steps between two checks of whether all episodes have ended. A check waits for the GPU, which
#: costs more than a few superfluous steps.
CHECK_EVERY = 64
#: Steps of a CUDA graph, a divisor of `CHECK_EVERY`.
STEPS_PER_GRAPH = 16


class RandomActions:
    """A policy that samples actions uniformly: the baseline for a trained one."""

    def __init__(self, action_space: Space):
        self.action_space = action_space

    def initial(self, n_lanes: int, device: torch.device | str) -> arrdict:
        return arrdict(lane=torch.zeros(n_lanes, device=device))

    def __call__(
        self,
        world: Mapping,
        state: Mapping,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, Mapping]:
        n_lanes, device = len(state["lane"]), state["lane"].device

        def draw(space):
            return spaces.random_actions(space, n_lanes, device, generator)

        return arrdict(actions=spaces.map(draw, self.action_space)), state


def step_until(
    is_over: torch.Tensor,
    step: Callable[[World, Tree], tuple[World, Tree]],
    world: World,
    state: Tree,
    env: Env,
    policies: tuple[Policy, ...],
    roots: tuple,
    max_steps: int,
) -> None:
    """Calls `world, state = step(world, state)` until all of `is_over` is true, or `max_steps`
    times. On a GPU, in CUDA graphs after the first `CHECK_EVERY` steps, where libraries initialise
    themselves, if `can_capture`; with a warning, if they cannot be recorded after all.

    Args:
        is_over: bool of any shape, which `step` changes in place.
        step: acts by `policies`, steps `env`, and changes only what is below them and `roots`.
        world: the current world.
        state: the hidden state before the first step.
        env: the environment.
        policies: the policies that act.
        roots: what else `step` changes, see `megastep.capture.capture`.
        max_steps: maximum number of steps.
    """

    def several(world, state, n_steps=STEPS_PER_GRAPH):
        for _ in range(n_steps):
            world, state = step(world, state)
        return world, state

    play, before = several, None
    for start in range(0, max_steps, STEPS_PER_GRAPH):
        if start % CHECK_EVERY == 0 and bool(is_over.all()):
            break
        if start == CHECK_EVERY and is_over.is_cuda:
            carried = world, state
            if can_capture(env, policies) and _has_fixed_form(before, carried):
                changed = is_over, *roots
                play = capture_with(env, policies, several, carried, changed, warmup=1)
        before = world, state
        if start + STEPS_PER_GRAPH <= max_steps:
            world, state = play(world, state)
        else:
            several(world, state, max_steps - start)


def can_capture(env: Env, policies: Sequence[Policy]) -> bool:
    """Returns whether steps of these may be replayed as a CUDA graph: if the environment is
    `capturable`, and each policy, too. A policy is, unless it says otherwise, if its class is
    megastep's, since others may keep a state where no graph sees it.
    """
    return optional(env, "capturable") and all(
        getattr(policy, "capturable", type(policy).__module__.startswith("megastep."))
        for policy in policies
    )


def _has_fixed_form(before, after):
    """Returns whether both trees have tensors only, under the same names."""
    (_, spec), (leaves, other) = map(_pytree.tree_flatten, (before, after))
    return spec == other and all(isinstance(leaf, torch.Tensor) for leaf in leaves)


@torch.no_grad()
def first_episodes(
    env: Env, policy: Policy, seed: int = 1, greedy: bool = False, max_steps: int = 100_000
) -> arrdict:
    """Plays the first episode of each lane.

    Args:
        seed: of the action sampling.
        greedy: takes the most likely actions instead of sampling.
        max_steps: maximum number of steps; unfinished episodes have `done` False.

    Returns:
        An arrdict on the environment's device:

        - returns, lengths: (B,) float32; lengths in steps
        - done: (B,) bool, true if the episode ended
        - learns: (B,) bool, from the first world; all true if worlds have no `learns`
        - metrics: name -> (B,) float32, from the last world of the episode; nan if unfinished
        - envs: (B,) int64, the lane's environment
        - homes: (B,) int32, the lane's layout; only if `env.layout` exists. Layouts change only at
          respawns, so the whole episode is played in it.
    """
    device, n_agents = torch.device(env.device), optional(env, "n_agents")
    draws = SeededGenerator(seed)
    world, state = env.reset(), policy.initial(n_lanes(env), device)
    layout = optional(env, "layout")
    envs = torch.arange(env.n_envs, device=device).repeat_interleave(n_agents)
    homes = {} if layout is None else {"homes": layout.repeat_interleave(n_agents)}
    returns, lengths = (torch.zeros(n_lanes(env), device=device) for _ in range(2))
    done = torch.zeros(n_lanes(env), dtype=torch.bool, device=device)
    learns = torch.ones_like(done) if "learns" not in world else world["learns"].clone()
    metrics = arrdict(
        {name: torch.full_like(returns, torch.nan) for name in world.get("metrics", {})}
    )

    def step(world, state):
        decision, state = policy(world, state, sample=not greedy, generator=draws.on(done.device))
        world = env.step(decision)
        returns.add_(torch.where(done, 0.0, world.reward))
        lengths.add_(~done)
        ends = (world.terminal | world.truncated) & ~done
        for name, values in metrics.items():
            values.copy_(torch.where(ends, world["metrics"][name], values))
        done.logical_or_(ends)
        return world, state

    changed = draws, returns, lengths, metrics
    step_until(done, step, world, state, env, (policy,), changed, max_steps)
    return arrdict(
        returns=returns,
        lengths=lengths,
        done=done,
        learns=learns,
        metrics=metrics,
        envs=envs,
        **homes,
    )


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
    resamples = np.random.default_rng(seed).integers(len(sums), size=(n_resamples, len(sums)))
    means = sums[resamples].sum(1) / counts[resamples].sum(1)
    lower, upper = np.quantile(means, [(1 - level) / 2, (1 + level) / 2])
    return float(values.mean()), float(lower), float(upper)


def sources_of(geometries: Sequence[Mapping]) -> list[str] | None:
    """Returns the `source` of each geometry, which `geometry=mixed` sets; None if one has none."""
    sources = [g.get("source") if isinstance(g, Mapping) else None for g in geometries]
    return None if None in sources else [*map(str, sources)] or None


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
    resamples = np.random.default_rng(seed).integers(n_homes, size=(n_resamples, n_homes))
    worst = order[np.sort(order.argsort()[resamples], 1)[:, :n_worst]]
    result = {}
    for name, by_home in means.items():
        mean, resampled = _finite_mean(by_home[order[:n_worst]]), _finite_mean(by_home[worst])
        numbers_in_worst = [None] * 3
        if np.isfinite(mean):
            levels = [(1 - level) / 2, (1 + level) / 2]
            numbers_in_worst = [float(mean), *np.nanquantile(resampled, levels).tolist()]
        result[name] = dict(zip(("mean", "lower", "upper"), numbers_in_worst, strict=True))
    return numbers[order[:n_worst]], result


def _finite_mean(values):
    """Returns the mean over the last axis of what is finite, nan if there is none."""
    is_finite = np.isfinite(values)
    counts = is_finite.sum(-1)
    means = np.where(is_finite, values, 0.0).sum(-1) / np.maximum(counts, 1)
    return np.where(counts > 0, means, np.nan)


def _means_by_home(values, homes):
    """Returns the mean of each home's finite values, nan if there is none."""
    is_finite = np.isfinite(values)
    counts = np.bincount(homes[is_finite], minlength=homes.max() + 1)
    sums = np.bincount(homes[is_finite], values[is_finite], len(counts))
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def worst_summary(episodes: Mapping) -> dict[str, Any]:
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
) -> list[dict[str, Any]]:
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


def _summary(episodes, lanes):
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


def _metric(values, groups):
    """Returns the mean of finite values with its 95 % interval by name; None for each if there are
    none.
    """
    is_finite = np.isfinite(values)
    values, groups = values[is_finite], groups[is_finite]
    numbers = interval(values, groups) if len(values) else (None,) * 3
    return dict(zip(("mean", "lower", "upper"), numbers, strict=True))
