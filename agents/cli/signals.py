"""Ctrl-C, SIGTERM and SIGHUP. The first signal stops the work in good order, the second ends the
program at once. The exit code is 128 + the signal's number.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import NoReturn, TextIO

from megastep.agents.cli import program

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: Seconds within which a repeated signal counts as the same one: `timeout` and closing terminals
#: send two.
SAME = 0.3


class Interrupted(BaseException):
    """A signal stopped the work; the message says what is saved and how to continue.

    It is no Exception, so that nothing takes it for an error of what it interrupted.
    """

    def __init__(self, number: int, message: str):
        super().__init__(number, message)
        self.number = number

    def __str__(self):
        return self.args[1]


def announce(number: int) -> None:
    """Says that the work will stop soon."""
    _write(sys.__stdout__, "\nStopping after this update (Ctrl-C again to quit now).")


def interrupt(number: int) -> NoReturn:
    """Raises Interrupted out of whatever is going on."""
    raise Interrupted(number, f"stopped by {signal.Signals(number).name}")


def exit_on_signals(script: str) -> None:
    """From here on a signal ends the program at once, with one line.

    For imports and the interpreter's end, which have nothing to save.
    """

    def exit_at_once(number, frame):
        _write(sys.__stderr__, f"{program.name(script)}: stopped by {signal.Signals(number).name}")
        os._exit(128 + number)

    _install(exit_at_once)


@contextlib.contextmanager
def handled(on_first: Callable[[int], None] = announce) -> Iterator[list[int]]:
    """Calls `on_first(number)` at the first signal; another Ctrl-C or SIGTERM ends the program.

    Ending harms nothing: checkpoints are renamed into place when whole. Yields a list that gets the
    number of the first signal.
    """
    numbers, first_at = [], []

    def handle(number, frame):
        if not numbers:
            first_at.append(time.monotonic())
            numbers.append(number)
            on_first(number)
        elif number != signal.SIGHUP and time.monotonic() - first_at[0] > SAME:
            os._exit(128 + number)

    before = _install(handle)
    try:
        yield numbers
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def stop(process: int) -> None:
    """Has another process stop in good order, once, though a terminal's Ctrl-C may have reached it
    as well: a second SIGHUP never ends a program.
    """
    with contextlib.suppress(ProcessLookupError):
        os.kill(process, signal.SIGTERM if _is_ignored(signal.SIGHUP) else signal.SIGHUP)


def _is_ignored(number: int) -> bool:
    """Returns whether a signal is kept from the program: `nohup` does so with SIGHUP."""
    return number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN


def _install(handler: Callable) -> dict[int, object]:
    """Handles all signals, in the main thread. Returns the handlers there were."""
    is_main = threading.current_thread() is threading.main_thread()
    numbers = [number for number in SIGNALS if is_main and not _is_ignored(number)]
    before = {number: signal.getsignal(number) for number in numbers}
    for number in numbers:
        signal.signal(number, handler)
    return before


def _write(stream: TextIO | None, line: str) -> None:
    """Prints from a signal handler: past the stream's buffer, which may be in use."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.write(stream.fileno(), f"{line}\n".encode())
