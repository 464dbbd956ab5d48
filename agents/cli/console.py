"""Lines, warnings, tables and progress for whoever watches, on a terminal or not. What cannot be
written, as its reader has left or its disk is full, never ends the work.
"""

import contextlib
import os
import sys
import threading
import time
import warnings
from collections.abc import Sequence
from io import StringIO
from typing import Any, TextIO

from rich import box
from rich.console import Console
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bars
from rich.table import Table

#: Seconds between two lines of progress where a line cannot be redrawn.
LINE_EVERY = 10
#: What every line begins with.
_prefix = ""


class TolerantStream:
    """A text stream that goes silent at its first failure, for good."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except (OSError, ValueError):
            self._silence()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except (OSError, ValueError):
            self._silence()

    def _silence(self) -> None:
        """What is buffered goes to the null device, or the interpreter's last flush would fail."""
        null = os.open(os.devnull, os.O_WRONLY)
        with contextlib.suppress(OSError, ValueError):
            os.dup2(null, self._stream.fileno())
        os.close(null)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def open_streams() -> None:
    """Makes stdout and stderr tolerant, whatever their encoding, and opens those that are closed,
    so that no file takes their number.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name) or open(os.devnull, "w")
        stream.reconfigure(errors="backslashreplace")
        setattr(sys, name, TolerantStream(stream))


def say(text: str = "", file: TextIO | None = None) -> None:
    """Prints a line, or several."""
    lines = "\n".join(f"{_prefix}{line}" for line in text.split("\n"))
    print(lines, file=file or sys.stdout, flush=True)


def prefix_lines(prefix: str) -> None:
    """Begins every line with `prefix`, and redraws none: where several processes print."""
    global _prefix
    _prefix = prefix


def warn(sentence: object) -> None:
    """One line on the error stream."""
    say(f"warning: {sentence}", sys.stderr)


def warn_in_lines() -> None:
    """Shows Python's warnings as such lines."""
    warnings.showwarning = lambda message, *_, **__: warn(message)


def warn_of_thread(failure: threading.ExceptHookArgs) -> None:
    """What ended a thread; of a disk that is full, as TensorBoard's may meet, in one line."""
    if isinstance(failure.exc_value, OSError):
        warn(f"{failure.thread.name} stopped: {failure.exc_value}")
    else:
        threading.__excepthook__(failure)


def is_interactive() -> bool:
    """Whether stdout can redraw a line: a terminal, not a dumb one, and no other process's too."""
    return (
        not _prefix
        and sys.stdout.isatty()
        and os.environ.get("TERM", "dumb") not in ("dumb", "unknown", "")
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str]], title: str | None = None) -> str:
    """A table as text, as wide as its contents, in characters that stdout can show."""
    is_unicode = (sys.stdout.encoding or "").lower().startswith("utf")
    grid = Table(
        *head, title=title, title_justify="left", box=box.HEAVY_HEAD if is_unicode else box.ASCII
    )
    for row in rows:
        grid.add_row(*row)
    console = Console(file=StringIO(), width=200, force_terminal=False, color_system=None)
    console.print(grid)
    return console.file.getvalue().rstrip("\n")


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as Markdown."""
    lines = (head, ("---",) * len(head), *rows)
    cells = ([cell.replace("|", "\\|") for cell in line] for line in lines)
    return "".join("| " + " | ".join(line) + " |\n" for line in cells)


class Progress:
    """A bar with a line of text on a terminal, a plain line every `LINE_EVERY` seconds elsewhere. A
    context.
    """

    def __init__(self):
        self.bars, self.last = None, -LINE_EVERY

    def __enter__(self):
        if is_interactive():
            self.bars = Bars(BarColumn(24), TextColumn("{task.description}"))
            self.task = self.bars.add_task("starting", total=1)
            self.bars.start()
        return self

    def __exit__(self, *error):
        if self.bars:
            self.bars.stop()

    def show(self, fraction: float | None, text: str) -> None:
        """`fraction` of the work is done, or None if it has no end."""
        if self.bars:
            total = None if fraction is None else 1
            self.bars.update(self.task, completed=fraction or 0, total=total, description=text)
        elif time.monotonic() - self.last >= LINE_EVERY:
            self.last = time.monotonic()
            say(text)


def number(value: float) -> str:
    """A count in three digits: 1.23M."""
    for limit, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= limit:
            return f"{value / limit:.3g}{unit}"
    return f"{value:.0f}"


def duration(seconds: float) -> str:
    """m:ss, or h:mm:ss."""
    minutes, seconds = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
