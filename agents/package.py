"""The package as its user sees it: its name, version, folders and commands."""

import os
import sys
from pathlib import Path

#: The distribution; the package and the command are called megastep.
DISTRIBUTION = "megastep-flatland"
ROOT = Path(__file__).resolve().parents[1]
#: configs/ of the repository, which the package carries as data.
CONFIGS = Path(__file__).resolve().parent / "configs"
#: The trained agents that the package carries as data.
PRETRAINED = Path(__file__).resolve().parent / "pretrained"


def command(script: str, python: str = "") -> str:
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
