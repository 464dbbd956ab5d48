"""Ctrl-C and SIGTERM: the first asks the training loop to stop after its step, the second ends the
program at once.
"""

import os
import signal

from agents.cli.console import say

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Interrupted(BaseException):
    """A signal stopped the work; the message says what is saved and how to go on. The exit code is
    128 + `number`. Like KeyboardInterrupt no Exception, so that what handles the errors of a video
    or a job lets it pass.
    """

    def __init__(self, number, message):
        super().__init__(message)
        self.number = number


class Interruptions:
    """While entered, `number` turns from None to that of the first signal, and nothing else
    happens.
    """

    def __init__(self):
        self.number = None

    def __enter__(self):
        try:
            self.before = {number: signal.signal(number, self._take) for number in SIGNALS}
        except ValueError:  # not the main thread: signals go elsewhere
            self.before = {}
        return self

    def __exit__(self, *error):
        for number, handler in self.before.items():
            signal.signal(number, handler)

    def _take(self, number, frame):
        if self.number is not None:
            os._exit(
                128 + number
            )  # a checkpoint is renamed into place when it is whole, so nothing is half-written
        self.number = number
        say("\nStopping after this step; once more stops at once.")
