"""megastep report run=RUN: one HTML file about a run, or about several."""

from pathlib import Path

from megastep.agents import console
from megastep.agents.cli.command import Command
from megastep.agents.errors import UserError
from megastep.agents.factory import settings
from megastep.settings import frozen

HELP = """Writes a report that opens in a browser, from one file without a server.

  megastep report run=RUN                its curves, evaluations, homes and films: RUN/report.html
  megastep report run=[A,B,...]          runs side by side, averaged over seeds: report.html here
  megastep report run=SWEEP              all jobs of a sweep: SWEEP/report.html
  megastep report run=RUN file=x.html    into this file, overwritten if it exists"""


@frozen
class Report:
    run: settings.Names
    file: str | None = None


def run(cfg: Report) -> None:
    """Writes the report of a run, or of several."""
    from megastep.agents.reports import report, runs  # with PyTorch

    paths = runs.expanded([*cfg.run])
    folder = paths[0] if len(paths) == 1 else Path()
    if len(paths) > 1 and len(cfg.run) == 1:
        folder = Path(cfg.run[0])  # of a sweep
    file = folder / "report.html" if cfg.file is None else Path(cfg.file)
    if file.suffix != ".html":
        raise UserError(f"file={file} is not a page; its name ends with .html")
    console.say(f"Report: {report.write(paths, file)}")


COMMAND = Command("report", Report, HELP)
main = COMMAND.main
