"""Turns the records of benchmark.py into a page with a table, and plots."""

import json
import re
import textwrap
from pathlib import Path

import numpy as np
from trainings import COMPARED, LEARNERS, METRICS
from workloads import BENCHMARKS

# Environments and frames per second of the original megastep's Explorer on one H200.
ORIGINAL = 16_384, 0.86e6
RUN_COLOURS = "tab:green", "tab:blue", "tab:red"  # by budget
ALL_SEEN = 59.1  # what 128 looks all round show of a test home, less the first view, on average
COLOURS = {"explorer": "tab:blue", "minimal": "tab:orange", "pointgoal": "tab:purple"}
PAGE = """# Benchmark table

Written by `python scripts/benchmarks/benchmark.py report` from `benchmarks.jsonl`. To measure:
`python scripts/benchmarks/benchmark.py BENCHMARK --json docs/lab/benchmarks.jsonl`, with `--device cpu`
for the CPU. [Benchmarks](benchmarks.md) explains the measurements.

![Frames per second against environments, both logarithmic]({plot})

A measurement is the median of n samples, beside it their 10th and 90th percentiles. A sample is the
mean over as many calls as fill 50 ms after warming up, timed by CUDA events on a GPU; or one
process; or one report of a training run. A return, or a share, is a mean with its 95 % bootstrap
interval over n homes, or lanes where there are none; a rating has two standard deviations to either
side. What has no spread was counted, or read once by Nsight Compute.

{benchmarks}

{table}
"""


def text(number):
    """A number as a table shows it."""
    return f"{number:,.0f}" if abs(number) >= 1000 else f"{number:.4g}"


HEADER = (
    "| benchmark | what | median | 10 % to 90 % | n | on | commit | date |\n" + 8 * "| --- " + "|"
)


def row(record):
    """A record as a line of the table."""
    spread = (
        "" if record["lower"] is None else f"{text(record['lower'])} to {text(record['upper'])}"
    )
    names = [("driver", record["driver"]), ("torch", record["torch"])]
    on = ", ".join([record["on"], *(f"{name} {version}" for name, version in names if version)])
    value = f"{text(record['value'])} {record['unit']}".strip()
    cells = [
        f"`{record['benchmark']}`",
        record["what"],
        value,
        spread,
        record["n"] or "",
        on,
        record["commit"],
        record["date"],
    ]
    return "| " + " | ".join(map(str, cells)) + " |"


def newest(records):
    """The newest record of each measurement on each GPU and on the CPU, in order of benchmark,
    place and name. Names that differ in duels won, or within a million of samples, are of the
    same measurement.
    """
    found = {}
    for record in sorted(records, key=lambda record: record["date"]):
        kind = "CPU" if record["on"].startswith("CPU") else record["on"]
        what = re.sub(r" \(\d+ won, .*?\)", "", record["what"])
        what = re.sub(r",\d{3},\d{3} samples", " M samples", what)
        found[record["benchmark"], kind, what] = record

    def order(key):
        benchmark, kind, what = key
        parts = re.split(r"(\d[\d,]*)", what)
        numbers = [int(part.replace(",", "")) for part in parts[1::2]]
        return list(BENCHMARKS).index(benchmark), kind == "CPU", kind, parts[::2], numbers

    return [found[key] for key in sorted(found, key=order)]


def page(records: list[dict], plot: str) -> str:
    """The page of ``records`` with the plot in the file ``plot``."""
    lines = [
        textwrap.fill(f"- `{name}`: {' '.join(b.__doc__.split())}", 100, subsequent_indent="  ")
        for name, b in BENCHMARKS.items()
    ]
    table = "\n".join([HEADER, *map(row, newest(records))])
    return PAGE.format(plot=plot, benchmarks="\n".join(lines), table=table)


def words(metric):
    """What a plot calls a metric."""
    return "SPL" if metric == "spl" else metric.replace("_", " ")


def save(figure, path):
    """Writes an SVG; the same figure gives the same file."""
    import matplotlib

    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "megastep"}):
        figure.savefig(path, metadata={"Date": None})


def plot(records, path):
    """Plots frames per second against environments, log-log; the same records give the same SVG."""
    from matplotlib.figure import Figure

    series = {}
    for record in newest(records):
        match = re.fullmatch(r"(\w+), `env.step`, ([\d,]+) environments", record["what"])
        if record["benchmark"] == "step" and match:
            bounds = [record[key] or record["value"] for key in ("value", "lower", "upper")]
            point = int(match[2].replace(",", "")), *(1e6 * end for end in bounds)
            series.setdefault((match[1], record["on"]), []).append(point)
    ax = Figure(figsize=(7.5, 4.8), layout="constrained").subplots()
    for (name, on), points in series.items():
        n, value, lower, upper = zip(*sorted(points))
        style = dict(color=COLOURS.get(name), linestyle="--" if on.startswith("CPU") else "-")
        ax.plot(n, value, marker="o", markersize=4, label=f"{name}, {on}", **style)
        ax.fill_between(n, lower, upper, color=style["color"], alpha=0.2, linewidth=0)
    ax.plot(*ORIGINAL, "kx", label="the original's Explorer, one H200", linestyle="none")
    ax.set(xscale="log", yscale="log", xlabel="environments", ylabel="frames per second")
    ticks = [2**k for k in range(10, 21, 2)]
    ax.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
    ax.minorticks_off()
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    save(ax.figure, path)


def learning_curves(records: list[dict]) -> dict[int, dict]:
    """By budget in seconds, of the newest runs on a GPU: `seconds` (P,), `mean`, `lower` and
    `upper` (P,) of the seeds' returns while they trained, and `evaluated`, a return per seed.
    """
    runs = {}
    for record in newest(records):
        match = re.match(r"training, (\d+) s, seed (\d+), (.*)", record["what"])
        if match and not record["on"].startswith("CPU"):
            runs.setdefault(int(match[1]), {}).setdefault(match[3], []).append(record)
    found = {}
    for budget, parts in sorted(runs.items()):
        curves = [np.array(record["curve"]) for record in parts["median rate"]]
        first = max(curve[0, 0] for curve in curves)
        seconds = np.geomspace(first, min(curve[-1, 0] for curve in curves), 50)
        returns = np.stack([np.interp(seconds, curve[:, 0], curve[:, 2]) for curve in curves])
        found[budget] = dict(
            seconds=seconds,
            mean=returns.mean(0),
            lower=returns.min(0),
            upper=returns.max(0),
            evaluated=[record["value"] for record in parts["return in unseen homes"]],
        )
    return found


def plot_learning(records, path):
    """Plots returns against seconds of training, a colour per budget."""
    from matplotlib.figure import Figure

    ax = Figure(figsize=(7.5, 4.8), layout="constrained").subplots()
    for (budget, run), colour in zip(learning_curves(records).items(), RUN_COLOURS):
        n_seeds = len(run["evaluated"])
        label = f"{budget} s, seeds: {n_seeds}, mean and range in training"
        ax.plot(run["seconds"], run["mean"], color=colour, label=label)
        ax.fill_between(
            run["seconds"], run["lower"], run["upper"], color=colour, alpha=0.2, linewidth=0
        )
        ax.plot([budget] * n_seeds, run["evaluated"], "o", color=colour, markersize=5)
    ax.plot([], [], "o", color="grey", markersize=5, label="evaluated in unseen homes, a seed each")
    ax.axhline(
        ALL_SEEN, color="grey", linewidth=1, linestyle="--", label="what 128 looks all round show"
    )
    ax.set(xscale="log", xlabel="seconds of training", ylabel="return", ylim=(0, None))
    ax.set_xticks([1, 10, 60, 240], ["1", "10", "60", "240"])
    ax.minorticks_off()
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8, loc="lower right")
    save(ax.figure, path)


def plot_worlds(records, path):
    """Plots the share that counts in each world against seconds of training, from runs on a GPU."""
    from matplotlib.figure import Figure

    drawn = [
        record
        for record in newest(records)
        if record["benchmark"] == "worlds"
        and "curve" in record
        # in self-play each side wins half of the points
        and "self-play" not in record["what"]
    ]
    if not drawn:
        return
    ax = Figure(figsize=(7.5, 4.2), layout="constrained").subplots()
    for record in drawn:
        name = record["what"].removesuffix(", median rate")
        counted = words(METRICS[name.split(",")[0].split()[0]])
        seconds, _, values = zip(*record["curve"])
        ax.plot(seconds, values, label=f"{name}: {counted}")
    ax.set(xscale="log", xlabel="seconds of training", ylabel="in training", ylim=(0, 1))
    ax.set_xticks([1, 3, 10, 30, 60], ["1", "3", "10", "30", "60"])
    ax.minorticks_off()
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8, loc="lower right")
    save(ax.figure, path)


def plot_learners(records, path):
    """Plots what counts in each world, on a GPU and on a CPU, against samples and against seconds,
    a colour per learner, a line per seed, of the runs that were given longest there.
    """
    from matplotlib.figure import Figure

    runs = {}
    for record in newest(records):
        if record["benchmark"] == "learners" and "curve" in record:
            world, name = record["what"].rsplit(", ", 3)[0].split(", ", 1)
            runs.setdefault((world, record["on"].split(",")[0]), []).append((name, record))
    if not runs:
        return
    figure = Figure(figsize=(9, 2.9 * len(runs)), layout="constrained")
    grid = figure.subplots(len(runs), 2, squeeze=False, sharey="row")
    colours = {name: f"C{i}" for i, name in enumerate(LEARNERS)}
    order = sorted(runs, key=lambda place: (place[1] == "CPU", list(COMPARED).index(place[0])))
    for (world, on), (left, right) in zip(order, grid):
        longest = max(record["curve"][-1][0] for _, record in runs[world, on])
        for name, record in sorted(runs[world, on], key=lambda one: list(LEARNERS).index(one[0])):
            seconds, samples, values = zip(*record["curve"])
            if seconds[-1] < 0.75 * longest:
                continue
            told = dict(color=colours[name], linewidth=1.2)
            is_first = ", seed 1," in record["what"]
            left.plot([n / 1e6 for n in samples], values, **told)
            right.plot(seconds, values, label=name if is_first else None, **told)
        counted = words(COMPARED[world][1])
        left.set(title=f"{world}, {on}", ylabel=f"{counted}, in training", xlabel="million samples")
        left.set(xscale="log", ylim=(0, None))
        right.set(title=f"{world}, {on}", xlabel="seconds of training")
        left.grid(alpha=0.3)
        right.grid(alpha=0.3)
    grid[0, 1].legend(fontsize=8)
    save(figure, path)


def plot_ratings(records, path):
    """Plots ratings of each run's snapshots, and of the scripted bot, against samples."""
    from matplotlib.figure import Figure

    runs = {}
    for record in newest(records):
        match = re.fullmatch(r"deathmatch, .*, seed (\d+), rating of (.*)", record["what"])
        if match:
            runs.setdefault(match[1], []).append((match[2], record["value"], record["upper"]))
    if not runs:
        return
    ax = Figure(figsize=(7.5, 4.2), layout="constrained").subplots()
    for i, (seed, rows) in enumerate(runs.items()):
        rated = [
            (float(name.split()[0].replace(",", "")) / 1e6, value, upper - value)
            for name, value, upper in rows
            if name.endswith(" samples")
        ]
        samples, values, spreads = zip(*sorted(rated))
        style = dict(color=f"C{i}", marker="o", markersize=4, capsize=3)
        ax.errorbar(samples, values, spreads, label=f"seed {seed}", **style)
        for name, value, _ in rows:
            if name == "Bot":
                label = "the scripted bot, with each" if i == 0 else None
                ax.axhline(value, color=f"C{i}", linestyle="--", linewidth=1, label=label)
    ax.set(xlabel="million samples", ylabel="rating ± two standard deviations")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8, loc="upper left")
    save(ax.figure, path)


def read(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def report(path: Path) -> None:
    """Writes the page and the plots beside the records in ``path``."""
    records = read(path)
    image = path.with_name("benchmark-table.svg")
    path.with_name("benchmark-table.md").write_text(page(records, image.name))
    plot(records, image)
    plot_learning(records, path.with_name("results.svg"))
    plot_worlds(records, path.with_name("worlds.svg"))
    plot_ratings(records, path.with_name("ratings.svg"))
    plot_learners(records, path.with_name("learners.svg"))
