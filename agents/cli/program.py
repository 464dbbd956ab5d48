"""The program as its user sees it: what it is called, and the errors it ends with."""

import contextlib
import os
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

#: The distribution; the package and the command are called megastep.
DISTRIBUTION = "megastep-flatland"
ROOT = Path(__file__).resolve().parents[2]
#: configs/ of the repository, which the package carries as data.
CONFIGS = Path(__file__).resolve().parents[1] / "configs"
#: The trained agents that the package carries as data.
PRETRAINED = Path(__file__).resolve().parents[1] / "pretrained"


def name(script: str, python: str = "") -> str:
    """`megastep train`, or `train.py` after `python`."""
    if Path(sys.argv[0]).parts[-2:] == ("megastep", "__main__.py"):
        return f"{python and 'python -m '}megastep {script}"
    is_installed = os.path.basename(sys.argv[0]) == "megastep"
    is_installed = is_installed or not (ROOT / f"{script}.py").exists()
    return f"megastep {script}" if is_installed else f"{python}{script}.py"


def version() -> str:
    from importlib import metadata  # which takes a while

    versions = [found.version for found in metadata.distributions(name=DISTRIBUTION)]
    return f"{DISTRIBUTION} {(versions or ['(not installed)'])[0]}"


class UserError(Exception):
    """Something the user can put right, in one sentence.

    Ends the program with the exit code `code`, without a traceback.
    """

    code = 2


class NonFinite(UserError):
    """Training stopped on numbers that are not finite, or went on without them."""

    code = 1


class Differs(UserError):
    """A run that was repeated gave other numbers."""

    code = 1


class ConfigErrors(UserError):
    """All errors of one configuration: `errors`, (dotted key, sentence) each."""

    def __init__(self, errors: Iterable[tuple[str, str]]):
        self.errors = list(errors)
        super().__init__(self.errors)

    def __str__(self):
        head = f"{len(self.errors)} error{'s' * (len(self.errors) > 1)} in the configuration"
        return "\n  ".join([head, *(f"{key}: {shortened(text, 400)}" for key, text in self.errors)])


@contextlib.contextmanager
def errors(
    prefix: str = "", kinds: tuple[type[BaseException], ...] = (OSError, ValueError)
) -> Iterator[None]:
    """Turns errors of these kinds into a UserError that begins with `prefix`."""
    try:
        yield
    except kinds as error:
        raise UserError(prefix + shortened(error, 400)) from error


def memory_problem(error: MemoryError | RuntimeError) -> str | None:
    """Returns what Python or PyTorch says of too little memory; None if the error is another."""
    if isinstance(error, MemoryError):
        return "Out of memory"
    problem = re.search("(DefaultCPUAllocator|CUDA out of memory|std::bad_alloc).*", str(error))
    return problem and problem[0].rstrip(".")


def shortened(text: object, length: int = 120) -> str:
    text = " ".join(str(text).split()) or type(text).__name__
    return text if len(text) <= length else f"{text[: length - 3]}..."
