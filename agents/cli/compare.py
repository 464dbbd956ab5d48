"""megastep compare run=[A,B]: a metric of several runs in one plot, averaged over seeds."""

from pathlib import Path

from megastep.agents import console
from megastep.agents.cli.command import Command
from megastep.agents.factory import settings

HELP = """Draws a metric of several runs over samples: a line for all runs that differ only in
their seeds, with a 95 % interval. Prints interquartile means; writes the numbers beside the plot.

  megastep compare run=[A,B,...]                    episode/return into compare.pdf
  megastep compare run=SWEEP metric=loss/value      all jobs of a sweep; any key of metrics.jsonl
  megastep compare run=[A,B] file=plot.svg          .pdf, .svg or .png, and plot.csv"""


def run(run: settings.Names, metric: str = "episode/return", file: str = "compare.pdf") -> None:
    """Draws a metric of several runs."""
    from megastep.agents.reports import compare, runs  # with PyTorch

    path = compare.write(runs.expanded([*run]), Path(file), metric)
    console.say(f"Plot: {path}, with its numbers in {path.with_suffix('.csv').name}")


COMMAND = Command("compare", run, HELP)
main = COMMAND.main
