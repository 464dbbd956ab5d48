"""Compares runs in one plot, averaged over seeds, and in a table of its numbers."""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

from megastep.agents import console
from megastep.agents.errors import UserError, user_errors
from megastep.agents.reports import runs, seeds
from megastep.atomic_files import write_atomically
from megastep.settings import closest

#: Endings of plots.
FORMATS = (".pdf", ".svg", ".png")


def write(paths: Sequence[Path], file: Path, metric: str = "episode/return") -> Path:
    """Draws a metric over samples, a line per group of runs that differ in their seeds alone, with
    a 95 % bootstrap interval over seeds. Prints the interquartile means, and writes the plot and,
    beside it, a .csv of its lines. Returns the plot's path.

    Raises:
        UserError: a folder is not a run, a run has not reported the metric, matplotlib fails, or a
            file cannot be written.
    """
    with user_errors("drawing needs matplotlib, which fails: ", (ImportError, ValueError)):
        from matplotlib.figure import Figure  # which takes a while
        from matplotlib.ticker import EngFormatter

    if file.suffix not in FORMATS:
        raise UserError(f"file={file} is not a plot; its name ends with {', '.join(FORMATS)}")
    every = [*map(runs.read, paths)]
    if metric not in (shared := runs.metrics_of(every)):
        if not shared:
            raise UserError("these runs share no metric, so they cannot be compared")
        raise UserError(f"not all of these runs report {metric!r}; {closest(metric, shared)}")
    groups, left_out = runs.without_interrupted(runs.groups_of(every))
    table, scores = [], {}
    figure = Figure(figsize=(5.5, 3.6), layout="constrained")
    axes = figure.subplots()
    for name, group in groups.items():
        one = seeds.band([run.curve(metric) for run in group])
        (line,) = axes.plot(one["x"], one["mean"], label=f"{name} ({len(group)})")
        axes.fill_between(one["x"], one["lower"], one["upper"], alpha=0.2, color=line.get_color())
        columns = zip(*(one[key].tolist() for key in ("x", "mean", "lower", "upper")), strict=True)
        table += [[name, *("" if math.isnan(value) else value for value in row)] for row in columns]
        scores[name] = [value for run in group if (value := run.score(metric)) is not None]
    axes.set_xlabel("samples")
    axes.set_ylabel(metric, parse_math=False)  # a $ is a $
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(alpha=0.3)
    for text in figure.legend(fontsize="small", loc="outside lower left").get_texts():
        text.set_parse_math(False)
    plot, text = io.BytesIO(), io.StringIO()
    figure.savefig(plot, format=file.suffix[1:], dpi=200, bbox_inches="tight")  # long names
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([["runs", "samples", "mean", "lower", "upper"], *table])
    with user_errors(f"{file} cannot be written: "):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file.with_suffix(".csv"), text.getvalue().encode())
        write_atomically(file, plot.getvalue())
    head = [text.format(metric) for text in seeds.POOLED]
    rows = seeds.pooled(scores)
    console.say("\n".join([console.table(head, rows, width=console.terminal_width()), *left_out]))
    return file
