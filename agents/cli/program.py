"""The program as its user sees it: what it is called, and the errors it ends with."""

import os
import sys
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

#: The distribution; the package and the command are called megastep.
DISTRIBUTION = "megastep-flatland"
ROOT = Path(__file__).resolve().parents[2]


def name(script: str, python: str = "") -> str:
    """Returns what a script is called, `megastep train` or `train.py`, the latter after `python`."""
    is_installed = os.path.basename(sys.argv[0]) == "megastep" or not (ROOT / "train.py").exists()
    return f"megastep {script}" if is_installed else f"{python}{script}.py"


def version() -> str:
    """Returns the distribution's name and version."""
    try:
        return f"{DISTRIBUTION} {metadata.version(DISTRIBUTION)}"
    except metadata.PackageNotFoundError:
        return f"{DISTRIBUTION}, not installed"


class UserError(Exception):
    """Something the user can put right, in one sentence. Ends the program with the exit code `code`,
    without a traceback.
    """

    def __init__(self, message: object, code: int = 2):
        super().__init__(message)
        self.code = code


class ConfigErrors(UserError):
    """All errors of one configuration: `errors`, (dotted key, sentence) each."""

    def __init__(self, errors: Iterable[tuple[str, str]]):
        self.errors = list(errors)
        super().__init__(self.errors)

    def __str__(self):
        count = "1 error" if len(self.errors) == 1 else f"{len(self.errors)} errors"
        lines = [f"{key}: {shortened(sentence, 400)}" for key, sentence in self.errors]
        return "\n  ".join([f"{count} in the configuration", *lines])


def shortened(text: object, length: int = 120) -> str:
    """Returns a text on one line of at most `length` characters."""
    text = " ".join(str(text).split())
    return text if len(text) <= length else f"{text[: length - 3]}..."


def first_line(error: BaseException) -> str:
    """Returns the first line of an error's message, or the name of its type."""
    return (str(error).splitlines() or [type(error).__name__])[0]
