"""Lines, warnings, tables and progress. Output that cannot be written never ends the work."""

import contextlib
import csv
import os
import re
import shutil
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from io import StringIO
from typing import Any, TextIO

from megastep.agents.errors import UserError

#: Seconds between two lines of progress where a line cannot be redrawn.
LINE_EVERY = 10
#: The beginning of every line, where one of several processes prints.
prefix = ""
#: Nothing is printed on stdout, as another process prints it.
is_silent = False


class TolerantStream:
    """A text stream that goes silent at its first failure, for good."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        self._attempt(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        self._attempt(self._stream.flush)

    def _attempt(self, method, *arguments) -> None:
        try:
            method(*arguments)
        except (OSError, ValueError):
            # the buffer goes to the null device, or the interpreter's last flush would fail
            with contextlib.suppress(OSError, ValueError), open(os.devnull, "w") as null:
                os.dup2(null.fileno(), self._stream.fileno())


def open_streams() -> None:
    """Makes stdout and stderr tolerant of errors and encodings, and opens closed ones."""
    threading.excepthook = warn_of_thread
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name) or open(os.devnull, "w")
        stream.reconfigure(errors="backslashreplace")
        setattr(sys, name, TolerantStream(stream))


#: What a terminal acts upon instead of showing it: control characters but tab and newline, and
#: those that turn the direction of what follows.
CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def visible(text: str) -> str:
    """Returns a text that may be from a stranger's file, with control characters as `\\x1b`."""
    return CONTROL.sub(lambda match: repr(match[0])[1:-1], text)


def say(text: str, file: TextIO | None = None) -> None:
    if is_silent and file is None:
        return
    text = visible(text)
    print(textwrap.indent(text, prefix, bool), file=file or sys.stdout, flush=True)


def warn(sentence: object, *_: object, **__: object) -> None:
    """One line on stderr; can stand in for `warnings.showwarning`."""
    say(f"warning: {sentence}", sys.stderr)


@contextlib.contextmanager
def warned(prefix: str = "") -> Iterator[None]:
    """Turns an OSError or a UserError into a warning that begins with `prefix`."""
    try:
        yield
    except (OSError, UserError) as error:
        warn(f"{prefix}{error}")


def warn_of_thread(failure: threading.ExceptHookArgs) -> None:
    """Prints why a thread ended, in one line if the disk is full, as TensorBoard's may find it."""
    if isinstance(failure.exc_value, OSError):
        name = failure.thread.name if failure.thread else "a thread"
        warn(f"{name} stopped: {failure.exc_value}")
    else:
        threading.__excepthook__(failure)


def is_unicode() -> bool:
    return (sys.stdout.encoding or "").lower().startswith("utf")


def table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    is_markdown: bool = False,
    width: int | None = None,
) -> str:
    """Returns a table as text, in Markdown or in characters that stdout can show. The last columns
    that do not fit into a width are left out, and named below.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table

    def shown(n, width=10_000) -> str:
        style = box.HEAVY_HEAD if is_unicode() else box.ASCII
        grid, text = Table(*head[:n], box=box.MARKDOWN if is_markdown else style), StringIO()
        for row in rows:
            grid.add_row(*(cell.replace("|", "\\|") if is_markdown else cell for cell in row[:n]))
        plain: dict = dict(markup=False, emoji=False, color_system=None)
        Console(file=text, width=width, force_terminal=False, **plain).print(grid)
        return text.getvalue().strip()

    n = len(head)
    text = shown(n)
    while width and n > 2 and max(map(len, text.splitlines())) > width:
        n -= 1
        text = shown(n, width if n == 2 else 10_000)  # whose cells are broken if they must be
    if n == len(head):
        return text
    return f"{text}\nToo wide for this terminal, but in the file: {', '.join(head[n:])}"


def as_csv(head: Sequence[str], rows: Iterable[Iterable[object]]) -> str:
    """Returns a table as CSV; what is None is empty."""
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerows([head, *rows])
    return text.getvalue()


def terminal_width() -> int | None:
    """Returns the columns of the terminal, None if stdout is none."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else None


def restore() -> None:
    """Shows the cursor, which a progress bar hides, where a process ends at once."""
    if sys.stdout.isatty():
        sys.stdout.write("\x1b[?25h\n")
        sys.stdout.flush()


class Progress:
    """A line of text with a `bar`, a context; where there is no terminal, one every 10 seconds."""

    def __init__(self, wait: float = 0):
        from rich import progress  # only for those who wait

        is_dumb = os.environ.get("TERM", "dumb") in ("dumb", "unknown", "")
        self.shown_at = time.monotonic() + wait - LINE_EVERY
        self.bar = progress.Progress(
            progress.BarColumn(24),
            progress.TextColumn("{task.description}"),
            disable=is_dumb or bool(prefix) or not sys.stdout.isatty(),
        )
        self.task = self.bar.add_task("starting", total=1)

    def show(self, fraction: float | None, words: Sequence[str]) -> None:
        """Shows words on one line; `fraction` of the work is done, None if it has no end."""
        text, total = (" · " if is_unicode() else "  ").join(words), None if fraction is None else 1
        self.bar.update(self.task, completed=fraction or 0, total=total, description=text)
        if self.bar.disable and time.monotonic() - self.shown_at >= LINE_EVERY:
            self.shown_at = time.monotonic()
            say(text)


#: What `count` calls.
_counts: list[Callable[[int, int], None]] = []


def count(done: int, total: int) -> None:
    """Says how much is done of work that may take long; `counting` shows it."""
    if _counts:
        _counts[-1](done, total)


@contextlib.contextmanager
def counting(what: str) -> Iterator[None]:
    """Shows how much of the work inside is done, such as `episodes`, and the time left."""
    last, began, first, progress = -1, 0.0, 0, Progress(wait=LINE_EVERY)
    with progress.bar:

        def show(done: int, total: int) -> None:
            nonlocal last, began, first
            if last < 0 or done < last:  # the first, or others begin
                began, first = time.monotonic(), done
            last, words = done, [f"{done:,} of {total:,} {what}"]
            if done > first:
                seconds = (time.monotonic() - began) * (total - done) / (done - first)
                words.append(f"{duration(seconds)} left")
            progress.show(done / max(total, 1), words)

        _counts.append(show)
        try:
            yield
        finally:
            _counts.remove(show)


def number(value: float) -> str:
    """A count in three digits: 1.23M."""
    for limit, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= limit:
            return f"{value / limit:.3g}{unit}"
    return f"{value:.0f}"


def duration(seconds: float) -> str:
    """A time in its two largest units: 5 s, 2 min 5 s, 1 h 2 min."""
    minutes, seconds = divmod(max(0, round(seconds)), 60)
    if minutes < 60:
        return f"{minutes} min {seconds} s" if minutes else f"{seconds} s"
    return f"{minutes // 60} h {minutes % 60} min"
