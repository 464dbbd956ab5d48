"""megastep compare run=[A,B]: a metric of several runs in one plot, averaged over seeds."""

from pathlib import Path
from typing import Literal

from megastep.agents import console
from megastep.agents.cli.command import Command
from megastep.agents.factory import settings

HELP = """Draws a metric of several runs over samples: a line for all runs that differ only in
their seeds, with a 95 % interval. Prints interquartile means; writes the numbers beside the plot.

  megastep compare run=[A,B,...]                    episode/return into compare.pdf
  megastep compare run=SWEEP metric=loss/value      all jobs of a sweep; any key of metrics.jsonl
  megastep compare run=[A,B] metric=eval/success    of evaluations, in training or afterwards
  megastep compare run=[A,B] labels=[ours,theirs]   also title=, xlabel=, ylabel=, legend=upper-left
  megastep compare run=[A,B] file=plot.svg          .pdf, .svg or .png, and plot.csv"""

Legend = Literal["best", "upper-left", "upper-right", "lower-left", "lower-right", "none"]


def run(
    run: settings.Names,
    metric: str = "episode/return",
    file: str = "compare.pdf",
    labels: settings.Names | None = None,
    title: str | None = None,
    xlabel: str = "samples",
    ylabel: str | None = None,
    legend: Legend = "best",
) -> None:
    """Draws a metric of several runs."""
    from megastep.agents.reports import compare, runs  # with PyTorch

    words = labels, title, xlabel, ylabel, legend
    path = compare.write(runs.expanded([*run]), Path(file), metric, *words)
    console.say(f"Plot: {path}, with its numbers in {path.with_suffix('.csv').name}")


COMMAND = Command("compare", run, HELP)
main = COMMAND.main
