"""Compares runs in one plot, averaged over seeds, and in a table of its numbers."""

import functools
import io
import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from megastep.agents import console
from megastep.agents.errors import UserError, user_errors
from megastep.agents.reports import runs, seeds
from megastep.agents.runs import folders
from megastep.settings import closest

#: Endings of plots.
FORMATS = (".pdf", ".svg", ".png")


def write(
    paths: Sequence[Path],
    file: Path,
    metric: str = "episode/return",
    labels: Sequence[str] | None = None,
    title: str | None = None,
    xlabel: str = "samples",
    ylabel: str | None = None,
    legend: str = "best",
) -> Path:
    """Draws a metric over samples, a line per group of runs that differ in their seeds alone, with
    a 95 % bootstrap interval over seeds. Prints the interquartile means, and writes the plot and,
    beside it, a .csv of its lines. Returns the plot's path. Raises UserError: a folder is not a
    run, a run has not reported the metric, there are more or fewer labels than lines, matplotlib
    fails, or a file cannot be written.

    Args:
        metric: a key of `metrics.jsonl`; `eval/NAME` of `evaluations/` as well.
        labels: of the lines, in the order of their runs. Default: the settings that differ.
        ylabel: default: the metric.
        legend: a place of matplotlib's, such as `upper-left`, or `none`.
    """
    with user_errors("drawing needs matplotlib, which fails: ", (ImportError, ValueError)):
        from matplotlib.figure import Figure  # which takes a while
        from matplotlib.ticker import EngFormatter

    if file.suffix not in FORMATS:
        raise UserError(f"file={file} is not a plot; its name ends with {', '.join(FORMATS)}")
    groups, left_out = runs.without_interrupted(runs.groups_of([*map(runs.read, paths)]))
    every = [run for group in groups.values() for run in group]
    if metric not in (shared := runs.metrics_of(every)):
        if not shared:
            raise UserError("these runs share no metric, so they cannot be compared")
        lacking = ", ".join(str(run.folder) for run in every if metric not in run.names())
        raise UserError(f"{lacking} did not report {metric!r}; {closest(metric, shared)}")
    labels = [*groups] if labels is None else labels
    if len(dict.fromkeys(labels)) != len(groups):
        raise UserError(f"labels= takes {len(groups)} different ones here, for {', '.join(groups)}")
    table, scores, wrap = [], {}, functools.partial(textwrap.fill, width=40)  # what the axes hold
    figure = Figure(figsize=(5.5, 3.6), layout="constrained")
    axes = figure.subplots()
    for name, group in zip(labels, groups.values(), strict=True):
        band = seeds.band([run.curve(metric) for run in group])
        x, mean, lower, upper = band.values()
        marker = "o" if np.ptp(x) == 0 else None
        (line,) = axes.plot(x, mean, marker=marker, label=wrap(f"{name} ({len(group)})"))
        axes.fill_between(x, lower, upper, alpha=0.2, color=line.get_color())
        rows = zip(*(part.tolist() for part in band.values()), strict=True)
        table += [[name, *("" if math.isnan(value) else value for value in row)] for row in rows]
        scores[name] = [value for run in group if (value := run.score(metric)) is not None]
    texts = [axes.set_xlabel(wrap(xlabel)), axes.set_ylabel(wrap(ylabel or metric))]
    texts += [axes.set_title(wrap(title))] if title else []
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(alpha=0.3)
    if legend != "none":
        place: Any = legend.replace("-", " ")
        texts += axes.legend(fontsize="small", loc=place).get_texts()
    for text in texts:
        text.set_parse_math(False)  # a $ is a $
    plot = io.BytesIO()
    figure.savefig(plot, format=file.suffix[1:], dpi=200)
    text = console.as_csv(["runs", "samples", "mean", "lower", "upper"], table)
    folders.write({file.with_suffix(".csv"): text, file: plot.getvalue()})
    head = [text.format(metric) for text in seeds.POOLED]
    rows = seeds.pooled(scores)
    console.say("\n".join([console.table(head, rows, width=console.terminal_width()), *left_out]))
    return file
