"""Signals: the first stops a script gracefully, a second Ctrl-C or SIGTERM at once."""

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

#: Signals that end a script at once when they are repeated.
QUITTING = (signal.SIGINT, signal.SIGTERM)
#: Signals by which clusters announce that SIGTERM will follow.
ANNOUNCING = (signal.SIGUSR1, signal.SIGUSR2)
SIGNALS = (*QUITTING, *ANNOUNCING, signal.SIGHUP)
#: Seconds within which a second signal counts as a repetition of the first: `timeout` and a closing
#: terminal send two.
SAME = 0.3


class Interrupted(BaseException):
    """A signal: its number, what was saved and how to continue. `except Exception` misses it."""


def announce(number: int) -> None:
    if environment.rank() == 0:
        _write(sys.__stdout__, "\nStopping after this update (Ctrl-C again to quit now).")


def interrupt(number: int) -> NoReturn:
    raise Interrupted(number, f"stopped by {signal.Signals(number).name}")


def exit_on_signals(script: str) -> None:
    """Makes signals end the process at once, with one line, while there is nothing to save."""

    def exit_at_once(number, frame) -> NoReturn:
        if environment.rank() == 0:
            name = signal.Signals(number).name
            _write(sys.__stderr__, f"{package.command(script)}: stopped by {name}")
        os._exit(128 + number)

    _install(exit_at_once)


@contextlib.contextmanager
def handled(
    on_first: Callable[[int], None], on_second: Callable[[int], None] = lambda number: None
) -> Iterator[list[int]]:
    """Handles signals for the context, which gets a list that the first signal's number joins. A
    second Ctrl-C or SIGTERM ends the process at once; after SIGUSR1 or SIGUSR2 it is the first.
    """
    numbers, ends_after = [], None

    def handle(number, frame) -> None:
        nonlocal ends_after
        # C++ imports parts of PyTorch, and aborts at an exception; nothing is to be saved yet
        if _is_importing_torch() and callable(outer := before.get(number)):
            return outer(number, frame)
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
    """Like `handled`; the block then ends with Interrupted even if a library swallows it."""
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
    """Delays signals until the block ends. For short steps that must not be interrupted."""
    numbers = []
    try:
        with handled(lambda number: None) as numbers:
            yield
    finally:
        if numbers:
            signal.raise_signal(numbers[0])


def stop(process: int) -> None:
    """Stops a process gracefully; unlike SIGTERM, SIGHUP never counts as a second signal."""
    is_ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    with contextlib.suppress(ProcessLookupError):
        os.kill(process, signal.SIGTERM if is_ignored else signal.SIGHUP)


def _install(handler: Callable) -> dict[int, Callable | int | None]:
    """Returns the previous handlers. Does nothing outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    is_ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN  # by nohup
    return {n: signal.signal(n, handler) for n in SIGNALS[: -1 if is_ignored else None]}


def _is_importing_torch() -> bool:
    spec = getattr(sys.modules.get("torch"), "__spec__", None)
    return getattr(spec, "_initializing", False)


def _write(stream: TextIO | None, line: str) -> None:
    # unbuffered: the signal may have interrupted a write to the stream
    with contextlib.suppress(OSError, ValueError, AttributeError):
        if stream is not None:
            os.write(stream.fileno(), f"{line}\n".encode())
