"""megastep compare run=[A,B]: a metric of several runs in one plot, averaged over seeds."""

from pathlib import Path

from megastep.agents import console
from megastep.agents.cli import plain_words
from megastep.agents.errors import UserError

HELP = """Draws a metric of several runs over samples: a line for all runs that differ only in
their seeds, with a 95 % interval. Prints interquartile means; writes the numbers beside the plot.

  megastep compare run=[A,B,...]                    episode/return into compare.pdf
  megastep compare run=SWEEP metric=loss/value      all jobs of a sweep; any key of metrics.jsonl
  megastep compare run=[A,B] file=plot.svg          .pdf, .svg or .png, and plot.csv"""


def main(words: list[str]) -> int:
    """Draws what the words of a command line ask for. Returns the exit code."""
    if not words or words[0] in ("-h", "--help"):
        console.say(HELP)
        return 0 if words else 2
    given = plain_words.parse(words, {"run": True, "metric": False, "file": False})
    if "run" not in given:
        raise UserError("run is missing; run=[A,B] names runs, run=SWEEP all jobs of a sweep")
    from megastep.agents.reports import compare, runs  # with PyTorch

    (metric,) = given.get("metric", ["episode/return"])
    (file,) = given.get("file", ["compare.pdf"])
    path = compare.write(runs.expanded(given["run"]), Path(file), metric)
    console.say(f"Plot: {path}, with its numbers in {path.with_suffix('.csv').name}")
    return 0
