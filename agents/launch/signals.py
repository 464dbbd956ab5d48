"""Ctrl-C, SIGTERM, SIGHUP, and SIGUSR1 and SIGUSR2, with which clusters announce that a job ends.
The first signal stops the work in good order, a second Ctrl-C or SIGTERM ends the program at once.
The exit code is 128 + the signal's number.
"""

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import NoReturn, TextIO

from megastep.agents import package
from megastep.agents.distributed import environment

#: The signals of people, which end the program at once when they are repeated.
QUITTING = (signal.SIGINT, signal.SIGTERM)
#: The signals of clusters: SIGTERM often follows them.
ANNOUNCING = (signal.SIGUSR1, signal.SIGUSR2)
SIGNALS = (*QUITTING, *ANNOUNCING, signal.SIGHUP)
#: Seconds within which a repeated signal counts as the same one: `timeout` and closing terminals
#: send two.
SAME = 0.3


class Interrupted(BaseException):
    """A signal stopped the work: Interrupted(number, message), where the message says what is saved
    and how to continue.

    It is no Exception, so that nothing takes it for an error of what it interrupted.
    """


def announce(number: int) -> None:
    _write(sys.__stdout__, "\nStopping after this update (Ctrl-C again to quit now).")


def interrupt(number: int) -> NoReturn:
    raise Interrupted(number, f"stopped by {signal.Signals(number).name}")


def exit_on_signals(script: str) -> None:
    """From here on a signal ends the program at once, with one line: for imports and the
    interpreter's end, which have nothing to save.
    """

    def exit_at_once(number, frame):
        if environment.rank() == 0:
            name = signal.Signals(number).name
            _write(sys.__stderr__, f"{package.command(script)}: stopped by {name}")
        os._exit(128 + number)

    _install(exit_at_once)


@contextlib.contextmanager
def handled(
    on_first: Callable[[int], None] = announce,
    on_second: Callable[[int], None] = lambda number: None,
) -> Iterator[list[int]]:
    """Calls `on_first(number)` at the first signal. Another Ctrl-C or SIGTERM ends the program,
    after `on_second(number)`, unless only SIGUSR1 or SIGUSR2 came before it.

    Ending harms nothing: checkpoints are renamed into place when whole. Yields a list that gets the
    number of the first signal.
    """
    numbers, ends_after = [], None

    def handle(number, frame):
        nonlocal ends_after
        is_repeated = ends_after is not None and time.monotonic() > ends_after
        if ends_after is None and number not in ANNOUNCING:
            ends_after = time.monotonic() + SAME
        if not numbers:
            numbers.append(number)
            on_first(number)
        elif number in QUITTING and is_repeated:
            on_second(number)
            os._exit(128 + number)

    before = _install(handle)
    try:
        yield numbers
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def interrupting(on_first: Callable[[int], None] = interrupt) -> Iterator[None]:
    """As `handled`, for an `on_first` that raises Interrupted.

    After a signal the block ends with Interrupted, whatever it raises or returns: libraries swallow
    the exception, and fail in their clean-up or on a module that was imported in part.
    """
    with handled(on_first) as numbers:
        try:
            yield
        except (Exception, SystemExit):
            if not numbers:
                raise
    if numbers:
        interrupt(numbers[0])


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """A signal that comes inside takes effect when the block ends: for what must not be done in
    part, and is quick.
    """
    numbers = []
    try:
        with handled(lambda number: None) as numbers:
            yield
    finally:
        if numbers:
            signal.raise_signal(numbers[0])


def stop(process: int) -> None:
    """Has another process stop in good order, once, though a terminal's Ctrl-C may have reached it
    as well: a second SIGHUP never ends a program.
    """
    is_ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    with contextlib.suppress(ProcessLookupError):
        os.kill(process, signal.SIGTERM if is_ignored else signal.SIGHUP)


def _install(handler: Callable) -> dict[int, object]:
    # in the main thread; nohup has SIGHUP ignored, which stays so; returns the handlers there were
    if threading.current_thread() is not threading.main_thread():
        return {}
    is_ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return {n: signal.signal(n, handler) for n in SIGNALS[: -1 if is_ignored else None]}


def _write(stream: TextIO | None, line: str) -> None:
    # from a signal handler: past the stream's buffer, which may be in use
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.write(stream.fileno(), f"{line}\n".encode())
