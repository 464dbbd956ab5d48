"""megastep report run=RUN: one HTML file about a run, or about several."""

from pathlib import Path

from megastep.agents import console
from megastep.agents.cli.command import Command
from megastep.agents.errors import UserError
from megastep.agents.factory import settings

HELP = """Writes a report that opens in a browser, from one file without a server.

  megastep report run=RUN                its curves, evaluations, homes and films: RUN/report.html
  megastep report run=[A,B,...]          runs side by side, averaged over seeds: report.html here
  megastep report run=SWEEP              all jobs of a sweep: SWEEP/report.html
  megastep report run=RUN file=x.html    into this file, overwritten if it exists"""


def run(run: settings.Names, file: str | None = None) -> None:
    """Writes the report of a run, or of several."""
    from megastep.agents.reports import report, runs  # with PyTorch

    paths = runs.expanded([*run])
    folder = paths[0] if len(paths) == 1 else Path()
    if len(paths) > 1 and len(run) == 1:
        folder = Path(run[0])  # of a sweep
    console.say(f"Report: {report.write(paths, page(file, folder / 'report.html'))}")


def page(file: str | None, default: Path) -> Path:
    """Returns the path of a page, by default `default`. Raises UserError if it is no page."""
    path = default if file is None else Path(file)
    if path.suffix != ".html":
        raise UserError(f"file={path} is not a page; its name ends with .html")
    return path


COMMAND = Command("report", run, HELP)
main = COMMAND.main
