"""How the program was started: by a script of the repository, or as the installed command."""

import os
import sys
from importlib import metadata
from pathlib import Path

COMMAND = "megastep"
#: The distribution, which has another name than the packages.
DISTRIBUTION = "megastep-flatland"
ROOT = Path(__file__).resolve().parents[2]


def is_command() -> bool:
    """Whether `megastep` was typed, or there are no scripts that could be."""
    return os.path.basename(sys.argv[0]) == COMMAND or not (ROOT / "train.py").exists()


def told(script: str) -> str:
    """What a message begins with."""
    return f"{COMMAND} {script}" if is_command() else f"{script}.py"


def typed(script: str) -> str:
    """What to type to run a script."""
    return f"{COMMAND} {script}" if is_command() else f"python {script}.py"


def version() -> str:
    """The distribution's name and version."""
    try:
        return f"{DISTRIBUTION} {metadata.version(DISTRIBUTION)}"
    except metadata.PackageNotFoundError:
        return f"{DISTRIBUTION}, not installed"


def completed(script: str) -> str:
    """What to type to have a shell complete words."""
    command = COMMAND if is_command() else typed(script)
    return f'eval "$({command} -sc install=bash)"'
