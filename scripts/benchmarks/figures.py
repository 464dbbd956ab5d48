"""Draws the figures of docs/lab from the records of benchmark.py.

The same records give the same SVG, byte for byte.
"""

import re
from pathlib import Path

import numpy as np
from records import newest

#: Environments and frames per second of the original megastep's Explorer, on one H200.
ORIGINAL_MEGASTEP = 16_384, 0.86e6
#: Explorer's mean return in test homes for seeing all that is visible from 128 points.
NEARLY_ALL_SEEN = 59.1
ENV_COLOURS = {"explorer": "tab:blue", "minimal": "tab:orange", "pointgoal": "tab:purple"}
ENV_COLOURS["memory_9"] = "tab:green"
BUDGET_COLOURS = "tab:green", "tab:blue", "tab:red"


def subplots(width, height, *grid, **options):
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained").subplots(*grid, **options)


def save(figure, path):
    import matplotlib

    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "megastep"}):
        figure.savefig(path, metadata={"Date": None})


def finish(ax, path, ticks=None, legend="best"):
    """Adds ticks, a grid and a legend to a figure's only axes, and saves it."""
    if ticks:
        ax.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
        ax.minorticks_off()
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8, loc=legend)
    save(ax.figure, path)


def is_cpu(record: dict) -> bool:
    return record["on"].startswith("CPU")


# ---- Steps ----


def plot_frames_per_second(records: list[dict], path: Path) -> None:
    """Plots frames per second over the number of environments, both logarithmic."""
    series = {}
    for record in newest(records):
        match = re.fullmatch(
            r"(\w+), `env.step`, ([\d,]+) environments(, as trained)?(, in a rollout)?",
            record["what"],
        )
        # the plain environment has a point per size already, without a rollout
        if record["benchmark"] == "step" and match and (match[3] or not match[4]):
            bounds = [record[key] or record["value"] for key in ("value", "lower", "upper")]
            n_envs, rates = int(match[2].replace(",", "")), [1e6 * bound for bound in bounds]
            series.setdefault((match[1], match[3] or "", record["on"]), {})[n_envs] = rates
    ax = subplots(7.5, 4.8)
    for (env, as_trained, machine), points in series.items():
        n_envs, value, lower, upper = zip(*((n, *rates) for n, rates in sorted(points.items())))
        dashes = "--" if machine.startswith("CPU") else ":" if as_trained else "-"
        style = dict(color=ENV_COLOURS.get(env), linestyle=dashes)
        label = f"{env}{as_trained}, {machine}"
        ax.plot(n_envs, value, marker="o", markersize=4, label=label, **style)
        ax.fill_between(n_envs, lower, upper, color=style["color"], alpha=0.2, linewidth=0)
    label = "Explorer of the original megastep, one H200"
    ax.plot(*ORIGINAL_MEGASTEP, "kx", label=label, linestyle="none")
    ax.set(xscale="log", yscale="log", xlabel="environments", ylabel="frames per second")
    finish(ax, path, ticks=[2**k for k in range(10, 21, 2)])


# ---- Training ----


def learning_curves(records: list[dict]) -> dict[int, dict]:
    """Returns the learning curves of `train` on a GPU by budget in seconds: those of the commit
    and the machine that were measured last.

    Each is a dict of `seconds` (P,); `mean`, `lower` and `upper` (P,) of the seeds' returns during
    training; and `evaluated`, a return per seed. P points.
    """
    records_by_budget = {}
    records = [record for record in records if record["benchmark"] == "train"]
    records = [record for record in records if not is_cpu(record)]
    for record in newest(records):
        match = re.match(r"training, (\d+) s, seed (\d+), (.*)", record["what"])
        if match and all(record[key] == records[-1][key] for key in ("commit", "on")):
            by_measurement = records_by_budget.setdefault(int(match[1]), {})
            by_measurement.setdefault(match[3], []).append(record)
    curves_by_budget = {}
    for budget, by_measurement in sorted(records_by_budget.items()):
        curves = [np.array(record["curve"]) for record in by_measurement["median rate"]]
        start, end = max(curve[0, 0] for curve in curves), min(curve[-1, 0] for curve in curves)
        seconds = np.geomspace(start, end, 50)
        returns = np.stack([np.interp(seconds, curve[:, 0], curve[:, 2]) for curve in curves])
        curves_by_budget[budget] = dict(
            seconds=seconds,
            mean=returns.mean(0),
            lower=returns.min(0),
            upper=returns.max(0),
            evaluated=[record["value"] for record in by_measurement["return in unseen homes"]],
        )
    return curves_by_budget


def plot_training(records: list[dict], path: Path) -> None:
    """Plots Explorer's return over seconds of training, a colour per budget."""
    ax = subplots(7.5, 4.8)
    curves = learning_curves(records)
    for (budget, run), colour in zip(curves.items(), BUDGET_COLOURS):
        n_seeds, seconds = len(run["evaluated"]), run["seconds"]
        label = f"{budget} s, {n_seeds} seeds, mean and range in training"
        ax.plot(seconds, run["mean"], color=colour, label=label)
        ax.fill_between(seconds, run["lower"], run["upper"], color=colour, alpha=0.2, linewidth=0)
        ax.plot([budget] * n_seeds, run["evaluated"], "o", color=colour, markersize=5)
    label = "evaluated in unseen homes, one point per seed"
    ax.plot([], [], "o", color="grey", markersize=5, label=label)
    style = dict(color="grey", linewidth=1, linestyle="--")
    ax.axhline(NEARLY_ALL_SEEN, label="nearly everything there is to see", **style)
    ax.set(xscale="log", xlabel="seconds of training", ylabel="return", ylim=(0, None))
    finish(ax, path, ticks=[1, *curves], legend="lower right")


def plot_scaling(records: list[dict], path: Path) -> None:
    """Plots samples per second over the number of GPUs, from `scaling`, beside linear scaling: of
    each environment the newest, on the machine that was measured last.
    """
    series = {}
    records = [record for record in records if record["benchmark"] == "scaling"]
    for record in newest(records):
        match = re.fullmatch(r"(\w+), training on (\d+) GPUs?", record["what"])
        if match and record["on"] == records[-1]["on"]:
            series.setdefault(match[1], {})[int(match[2])] = record["value"]
    if not series:
        return
    ax = subplots(6, 3.6)
    for env, by_count in series.items():
        counts, colour = sorted(by_count), ENV_COLOURS[env]
        rates = [by_count[n] for n in counts]
        ax.plot(counts, rates, marker="o", color=colour, label=env)
        linear = [n * by_count[1] for n in counts]
        ax.plot(counts, linear, color=colour, linestyle=":", label=f"{env}, linear")
    ax.set(xlabel="GPUs", ylabel="million samples per second", xlim=(0, None), ylim=(0, None))
    finish(ax, path, ticks=sorted({n for by_count in series.values() for n in by_count}))
