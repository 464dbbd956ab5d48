"""megastep web run=RUN: a page that plays a trained agent in a browser, from one file."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from megastep.agents import console
from megastep.agents.cli.command import Command
from megastep.agents.cli.report import page
from megastep.agents.runs import folders

HELP = """Writes a page that plays a trained agent in a browser, from one file without a server.

  megastep web run=RUN                 RUN/page.html; a packaged agent: NAME.html here
  megastep web run=RUN homes=[3,7]     in these homes of split=test; default: the first four
  megastep web run=RUN against=OTHER   two agents, the other one of another run
  megastep web run=RUN seed=5          the seed of the first episodes
  megastep web run=RUN file=x.html     into this file, overwritten if it exists

The page has keys to play, pause and step, and to drive an agent yourself. docs/web.md says how to
put it on a site of your own."""


def run(
    run: str,
    against: str | None = None,
    homes: tuple[Annotated[int, Field(ge=0)], ...] | None = None,
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 1,
    file: str | None = None,
) -> Path:
    """Writes a page, and says where and how large it is. Returns its path."""
    path = page(file, folders.folder_of(folders.find(run)) / "page.html")
    from megastep.agents.export import web  # with PyTorch

    text = web.make(run, against, homes if homes is None else [*homes], seed)
    folders.write({path: text})
    console.say(f"Wrote {path}, {len(text) / 1e6:.2f} MB: open it in a browser")
    return path


COMMAND = Command("web", run, HELP)
main = COMMAND.main
