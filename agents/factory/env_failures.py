"""What is said and kept of an error that an environment of somebody else raises."""

import contextlib
import inspect
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

from megastep import engine
from megastep.agents.distributed import process_group
from megastep.agents.errors import UserError, memory_problem
from megastep.agents.factory.settings import Env
from megastep.hosting.env_error import EnvError, one_line
from megastep.imports import import_object

#: Has the traceback, in the run's folder.
FILE = "env_error.txt"
METHODS = "__init__", "reset", "step", "check", "desync"


class EnvFailed(UserError):
    """An environment of somebody else raised an error."""

    code = 4


@contextlib.contextmanager
def caught(env: Env, folder: Path, saved: Callable[[], str] = lambda: "") -> Iterator[None]:
    """Turns errors of others' environments into EnvFailed, their traceback in a file."""
    try:
        yield
    except Exception as error:
        if not (failure := _failure(error, env)):
            raise
        is_sentence = isinstance(error, UserError)  # that a video could not be made because of it
        text = [str(error if is_sentence else failure).rstrip("."), saved()]
        if failure.trace:
            rank = process_group.rank()
            path = folder / (f"rank_{rank}_{FILE}" if rank else FILE)
            with contextlib.suppress(OSError):
                path.write_text(failure.trace, "utf-8", "backslashreplace")
                text.insert(1, f"Its traceback is in {path}")
        raise EnvFailed(". ".join(filter(None, text))) from error


def _failure(error, env) -> EnvError | None:
    """Returns the error of an environment as an EnvError, None if another's code raised it."""
    if isinstance(error, (EnvError, UserError)):
        while error is not None and not isinstance(error, EnvError):
            error = error.__cause__
        return error
    is_sentence = isinstance(error, engine.EngineError)
    if isinstance(error, (MemoryError, RuntimeError)):
        is_sentence |= memory_problem(error) is not None
    if is_sentence or env.name.startswith("megastep."):
        return None
    kind = import_object(env.name)
    methods = [inspect.unwrap(getattr(kind, name, None) or kind) for name in METHODS]
    codes = {method.__code__ for method in methods if hasattr(method, "__code__")}
    frames = error.__traceback__
    while frames and frames.tb_frame.f_code not in codes:
        frames = frames.tb_next
    trace = "".join(traceback.format_exception(type(error), error, frames))
    if not frames:
        return None
    return EnvError(f"{env.name} failed: {one_line(error)}", trace)
