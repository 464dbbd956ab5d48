"""megastep report run=RUN: one HTML file about a run, or about several."""

from pathlib import Path

from megastep.agents import console
from megastep.agents.cli import plain_words
from megastep.agents.errors import UserError

HELP = """Writes a report that opens in a browser, from one file without a server.

  megastep report run=RUN                its curves, evaluations, homes and films: RUN/report.html
  megastep report run=[A,B,...]          runs side by side, averaged over seeds: report.html here
  megastep report run=SWEEP              all jobs of a sweep: SWEEP/report.html
  megastep report run=RUN file=x.html    into this file, overwritten if it exists"""


def main(words: list[str]) -> int:
    """Writes the report that the words of a command line ask for. Returns the exit code."""
    if not words or words[0] in ("-h", "--help"):
        console.say(HELP)
        return 0 if words else 2
    given = plain_words.parse(words, {"run": True, "file": False})
    if "run" not in given:
        raise UserError("run is missing; run=latest takes the newest run, run=[A,B] several")
    from megastep.agents.reports import report, runs  # with PyTorch

    paths = runs.expanded(given["run"])
    folder = paths[0] if len(paths) == 1 else Path()
    if len(paths) > 1 and len(given["run"]) == 1:
        folder = Path(given["run"][0])  # of a sweep
    file = Path(given["file"][0]) if "file" in given else folder / "report.html"
    if file.suffix != ".html":
        raise UserError(f"file={file} is no page; its name ends with .html")
    console.say(f"Report: {report.write(paths, file)}")
    return 0
