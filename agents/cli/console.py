"""Lines, warnings, tables and progress, on a terminal or not. Output that cannot be written, as on
a full disk or a closed pipe, never ends the work.
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

from rich import box, progress
from rich.console import Console
from rich.table import Table

#: Seconds between two lines of progress where a line cannot be redrawn.
LINE_EVERY = 10
#: The beginning of every line, where one of several processes prints.
prefix = ""


class TolerantStream:
    """A text stream that goes silent at its first failure, for good."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        self._attempt(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        self._attempt(self._stream.flush)

    def _attempt(self, method, *arguments):
        try:
            method(*arguments)
        except (OSError, ValueError):
            # the buffer goes to the null device, or the interpreter's last flush would fail
            null = os.open(os.devnull, os.O_WRONLY)
            with contextlib.suppress(OSError, ValueError):
                os.dup2(null, self._stream.fileno())
            os.close(null)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def open_streams() -> None:
    """Makes stdout and stderr tolerant of errors and encodings, and opens those that are closed, so
    that no file takes their number.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name) or open(os.devnull, "w")
        stream.reconfigure(errors="backslashreplace")
        setattr(sys, name, TolerantStream(stream))


def say(text: str = "", file: TextIO | None = None) -> None:
    """Prints one line or several."""
    lines = "\n".join(f"{prefix}{line}" for line in text.split("\n"))
    print(lines, file=file or sys.stdout, flush=True)


def warn(sentence: object, *_: Any, **__: Any) -> None:
    """Prints one line on stderr. Can stand in for `warnings.showwarning`."""
    say(f"warning: {sentence}", sys.stderr)


def warn_of_thread(failure: threading.ExceptHookArgs) -> None:
    """Prints why a thread ended, in one line if the disk is full, as TensorBoard's may find it."""
    if isinstance(failure.exc_value, OSError):
        warn(f"{failure.thread.name} stopped: {failure.exc_value}")
    else:
        threading.__excepthook__(failure)


def is_unicode() -> bool:
    """Returns whether stdout can show more than ASCII."""
    return (sys.stdout.encoding or "").lower().startswith("utf")


def table(head: Sequence[str], rows: Sequence[Sequence[str]], title: str | None = None) -> str:
    """Returns a table as text, as wide as its contents, in characters that stdout can show."""
    style = box.HEAVY_HEAD if is_unicode() else box.ASCII
    grid = Table(*head, title=title, title_justify="left", box=style)
    for row in rows:
        grid.add_row(*row)
    console = Console(file=StringIO(), width=200, force_terminal=False, color_system=None)
    console.print(grid)
    return console.file.getvalue().rstrip("\n")


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Returns a table as Markdown."""
    lines = (head, ("---",) * len(head), *rows)
    cells = ([cell.replace("|", "\\|") for cell in line] for line in lines)
    return "".join("| " + " | ".join(line) + " |\n" for line in cells)


class Progress(contextlib.ExitStack):
    """A context: a bar with a line of text on a terminal, elsewhere a line every 10 seconds."""

    bars, shown_at = None, -LINE_EVERY

    def __enter__(self):
        is_terminal = sys.stdout.isatty() and not prefix
        if is_terminal and os.environ.get("TERM", "dumb") not in ("dumb", "unknown", ""):
            columns = progress.BarColumn(24), progress.TextColumn("{task.description}")
            self.bars = self.enter_context(progress.Progress(*columns))
            self.task = self.bars.add_task("starting", total=1)
        return self

    def show(self, fraction: float | None, words: Sequence[str]) -> None:
        """Shows words on one line; `fraction` of the work is done, None if it has no end."""
        text = (" · " if is_unicode() else "  ").join(words)
        if self.bars:
            total = None if fraction is None else 1
            self.bars.update(self.task, completed=fraction or 0, total=total, description=text)
        elif time.monotonic() - self.shown_at >= LINE_EVERY:
            self.shown_at = time.monotonic()
            say(text)


def number(value: float) -> str:
    """Returns a count in three digits: 1.23M."""
    for limit, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= limit:
            return f"{value / limit:.3g}{unit}"
    return f"{value:.0f}"


def duration(seconds: float) -> str:
    """Returns a time in its two largest units: 5 s, 2 min 5 s, 1 h 2 min."""
    minutes, seconds = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"
