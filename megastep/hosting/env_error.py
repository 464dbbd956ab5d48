"""Errors of environments of somebody else, with their tracebacks as text."""

import traceback
from pathlib import Path

_HERE = str(Path(__file__).parent)


class EnvError(RuntimeError):
    """An environment of somebody else raised an error: a sentence, and its traceback as text."""

    def __init__(self, sentence: str, trace: str = ""):
        super().__init__(sentence, trace)
        self.trace = trace

    def __str__(self) -> str:
        return self.args[0]

    @classmethod
    def of(cls, error: Exception, place: str) -> "EnvError":
        """Returns an error that was raised in a place, such as `environment 3`, as an EnvError."""
        frames = error.__traceback__
        while frames and frames.tb_frame.f_code.co_filename.startswith(_HERE):
            frames = frames.tb_next
        trace = "".join(traceback.format_exception(type(error), error, frames))
        return cls(f"{place} failed: {one_line(error)}", trace)


class BadValue(EnvError):
    """An environment gave what its spaces or Gymnasium's interface do not allow."""

    @classmethod
    def of(cls, problem: str, place: str) -> "BadValue":
        return cls(f"{place}: {problem}. To leave it as it is, use env.check=false")


def one_line(error: BaseException) -> str:
    """Returns the type of an error and the first line of its message."""
    line = next(iter(str(error).strip().splitlines()), "")
    return ": ".join(filter(None, [type(error).__name__, line[:300]]))
