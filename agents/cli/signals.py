"""Ctrl-C, SIGTERM and SIGHUP: the first stops the work in good order, the second ends the program
at once. The exit code is 128 + the signal's number.
"""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn, TextIO

from megastep.agents.cli.doors import told

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: Seconds in which a repeated signal is the same one: `timeout` and closing terminals send two.
SAME = 0.3


class Interrupted(BaseException):
    """A signal stopped the work; the message says what is saved and how to go on. It is no
    Exception, so that nothing takes it for an error of what it interrupted.
    """

    def __init__(self, number: int, message: str):
        super().__init__(message)
        self.number = number

    def __reduce__(self):  # between the processes of a sweep
        return type(self), (self.number, str(self))


def announce(number: int) -> None:
    """Says that the work will stop soon."""
    _write(sys.__stdout__, "\nStopping after this step; once more stops at once.")


def interrupt(number: int) -> NoReturn:
    """Raises Interrupted out of whatever is going on."""
    raise Interrupted(number, f"stopped by {signal.Signals(number).name}")


def _write(stream: TextIO | None, line: str) -> None:
    """Prints from a signal handler: past the stream's buffer, which may be in use."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.write(stream.fileno(), f"{line}\n".encode())


def is_ignored(number: int) -> bool:
    """Whether whoever started the program keeps a signal from it: `nohup` does so with SIGHUP."""
    return number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN


def exit_on_signals(script: str) -> None:
    """From here on a signal ends the program at once, with one line: for imports and the
    interpreter's end, which have nothing to save.
    """

    def exit_at_once(number, frame):
        _write(sys.__stderr__, f"{told(script)}: stopped by {signal.Signals(number).name}")
        os._exit(128 + number)

    for number in SIGNALS:
        if not is_ignored(number):
            signal.signal(number, exit_at_once)


class Interruptions:
    """While entered, the first signal calls `on_first(number)` and sets `number`; another Ctrl-C or
    SIGTERM ends the program, which harms nothing: checkpoints are renamed into place when whole.
    """

    def __init__(self, on_first: Callable[[int], None] = announce):
        self.on_first, self.number, self.first_at = on_first, None, 0.0

    def __enter__(self):
        taken = [number for number in SIGNALS if not is_ignored(number)]
        self.before = {}
        with contextlib.suppress(ValueError):  # not the main thread: signals go elsewhere
            self.before |= {number: signal.signal(number, self._take) for number in taken}
        return self

    def __exit__(self, *error):
        for number, handler in self.before.items():
            signal.signal(number, handler)

    def _take(self, number: int, frame: object) -> None:
        if self.number is None:
            self.number, self.first_at = number, time.monotonic()
            self.on_first(number)
        elif number != signal.SIGHUP and time.monotonic() - self.first_at > SAME:
            os._exit(128 + number)


def stop(process: int) -> None:
    """Has another process that is under `Interruptions` stop in good order, though a terminal's
    Ctrl-C may have reached it as well: a second SIGHUP is no second signal.
    """
    with contextlib.suppress(ProcessLookupError):
        os.kill(process, signal.SIGTERM if is_ignored(signal.SIGHUP) else signal.SIGHUP)


def is_below(process: int) -> bool:
    """Whether a process lives that this one, or one of those that it started, has started."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        while process > 1:
            if process == os.getpid():
                return True
            status = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
            if status[0] == "Z":
                return False
            process = int(status[1])
    return False
