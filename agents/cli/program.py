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
    """Returns what a script is called: `megastep train`, or `train.py` after `python`."""
    is_installed = os.path.basename(sys.argv[0]) == "megastep" or not (ROOT / "train.py").exists()
    return f"megastep {script}" if is_installed else f"{python}{script}.py"


def version() -> str:
    versions = [found.version for found in metadata.distributions(name=DISTRIBUTION)]
    return f"{DISTRIBUTION} {(versions or ['(not installed)'])[0]}"


class UserError(Exception):
    """Something the user can put right, in one sentence. Ends the program with the exit code `code`,
    without a traceback.
    """

    code = 2


class NonFinite(UserError):
    """Training stopped on numbers that are not finite, or went on without them."""

    code = 1


class ConfigErrors(UserError):
    """All errors of one configuration: `errors`, (dotted key, sentence) each."""

    def __init__(self, errors: Iterable[tuple[str, str]]):
        self.errors = list(errors)
        super().__init__(self.errors)

    def __str__(self):
        head = f"{len(self.errors)} error{'s' * (len(self.errors) > 1)} in the configuration"
        return "\n  ".join([head, *(f"{key}: {shortened(text, 400)}" for key, text in self.errors)])


def shortened(text: object, length: int = 120) -> str:
    text = " ".join(str(text).split())
    return text if len(text) <= length else f"{text[: length - 3]}..."


def first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
