"""Closes an environment, which may be somebody else's and fail at it."""

import contextlib
import signal
import threading
import warnings
from collections.abc import Iterator
from typing import NoReturn

from megastep.types import Env, optional

#: Seconds in which an environment must close itself.
PATIENCE = 10.0


def close_env(env: Env, seconds: float = PATIENCE) -> None:
    """Closes an environment. An error, or one that takes longer, is a warning."""
    try:
        with _limited(seconds):
            optional(env, "close")()
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".partition("\n")[0]
        warnings.warn(f"The environment could not be closed: {reason}", stacklevel=2)


@contextlib.contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """Raises TimeoutError in what takes longer. Only in the main thread, which alone can be
    interrupted, and where no other alarm is set.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGALRM) is not signal.SIG_DFL:
        yield
        return

    def interrupt(number, frame) -> NoReturn:
        raise TimeoutError(f"it took more than {seconds:g} s")

    signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
