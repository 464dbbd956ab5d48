"""Errors that a user can put right, each one sentence."""

import contextlib
import re
from collections.abc import Iterable, Iterator

#: The exit codes of every command.
EXIT_CODES = {
    0: "done",
    1: "training stopped because of NaN or infinite numbers, a checkpoint is damaged, a job of a "
    "sweep failed, or a result or a run was not reproduced",
    2: "error in the configuration, environment, a file, or memory: one sentence with the cure",
    3: "one of several ranks was killed or cannot be reached; the last checkpoint is intact",
    4: "an environment of another package or of your own raised an error: all is saved, and its "
    "traceback is in the run's `env_error.txt`",
    129: "stopped by SIGHUP; a checkpoint was saved",
    130: "stopped by Ctrl-C; a checkpoint was saved",
    138: "stopped by SIGUSR1; a checkpoint was saved",
    140: "stopped by SIGUSR2; a checkpoint was saved",
    143: "stopped by SIGTERM; a checkpoint was saved",
}


class UserError(Exception):
    """Something the user can put right, in one sentence. Ends the program with `code`."""

    code = 2

    def __init__(self, text: object, code: int | None = None):
        super().__init__(text)
        self.code = self.code if code is None else code


class ConfigErrors(UserError):
    """All errors of one configuration: `errors`, (dotted key, sentence) each."""

    def __init__(self, errors: Iterable[tuple[str, str]]):
        self.errors = list(errors)
        super().__init__(self.errors)

    def __str__(self) -> str:
        head = f"{len(self.errors)} error{'s' * (len(self.errors) > 1)} in the configuration"
        return "\n  ".join([head, *(f"{key}: {shortened(text, 400)}" for key, text in self.errors)])


@contextlib.contextmanager
def user_errors(
    prefix: str = "", kinds: tuple[type[BaseException], ...] = (OSError, ValueError)
) -> Iterator[None]:
    """Turns errors of these kinds into a UserError that begins with `prefix`."""
    try:
        yield
    except kinds as error:
        raise UserError(prefix + shortened(error, 400)) from error


def memory_problem(error: Exception) -> str | None:
    """Returns what Python or PyTorch says of too little memory; None if the error is another."""
    if isinstance(error, MemoryError):
        return "Out of memory"
    problem = re.search("(DefaultCPUAllocator|CUDA out of memory|std::bad_alloc).*", str(error))
    return problem and problem[0].rstrip(".")


def shortened(text: object, length: int = 120) -> str:
    """Returns a text, or an error's message, on one line of at most so many characters."""
    text = " ".join(str(text).split()) or type(text).__name__
    return text if len(text) <= length else f"{text[: length - 3]}..."
