"""Lines, warnings, tables and progress for whoever watches, on a terminal or not, and for nobody
once they leave.
"""

import os
import sys
import time
from io import StringIO

from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bars
from rich.table import Table

#: Seconds between two lines of progress where a line cannot be redrawn.
QUIET = 10


def say(text="", file=None):
    """Prints a line; if nobody reads any more (`| head`), it and every later line go nowhere, and
    the work goes on.
    """
    file = file or sys.stdout
    try:
        print(text, file=file, flush=True)
    except BrokenPipeError:
        deafen(file)


def warn(sentence):
    """One line on the error stream."""
    say(f"warning: {sentence}", sys.stderr)


def deafen(file):
    """Points a stream nobody reads at the null device, so that not even the interpreter's last
    flush fails on it.
    """
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, file.fileno())
    os.close(null)


class Steady(Console):
    """A rich console that outlives its reader; rich's own would end the program."""

    def on_broken_pipe(self):
        self.quiet = True
        deafen(self.file)


def is_interactive():
    """Whether stdout can redraw a line: a terminal, and not a dumb one."""
    return sys.stdout.isatty() and os.environ.get("TERM", "dumb") not in ("dumb", "unknown", "")


def table(head, rows, title=None):
    """A table as text, as wide as its contents."""
    grid = Table(*head, title=title, title_justify="left")
    for row in rows:
        grid.add_row(*row)
    console = Console(file=StringIO(), width=200, force_terminal=False, color_system=None)
    console.print(grid)
    return console.file.getvalue().rstrip("\n")


class Progress:
    """A bar with a line of text on a terminal, a plain line every `QUIET` seconds elsewhere. A
    context.
    """

    def __init__(self):
        self.bars, self.last = None, -QUIET

    def __enter__(self):
        if is_interactive():
            self.bars = Bars(BarColumn(24), TextColumn("{task.description}"), console=Steady())
            self.task = self.bars.add_task("starting", total=1)
            self.bars.start()
        return self

    def __exit__(self, *error):
        if self.bars:
            self.bars.stop()

    def show(self, fraction, text):
        """`fraction` of the work is done, or None if it has no end."""
        if self.bars:
            total = None if fraction is None else 1
            self.bars.update(self.task, completed=fraction or 0, total=total, description=text)
        elif time.monotonic() - self.last >= QUIET:
            self.last = time.monotonic()
            say(text)


def number(value):
    """A count in three digits: 1.23M."""
    for limit, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= limit:
            return f"{value / limit:.3g}{unit}"
    return f"{value:.0f}"


def duration(seconds):
    """m:ss, or h:mm:ss."""
    seconds = max(0, round(seconds))
    minutes, seconds = divmod(seconds, 60)
    return (
        f"{minutes // 60}:{minutes % 60:02}:{seconds:02}"
        if minutes >= 60
        else f"{minutes}:{seconds:02}"
    )
