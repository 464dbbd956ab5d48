"""Follows pages of docs/: writes their files into a folder and runs their commands."""

import contextlib
import re
import shlex
import sys
from pathlib import Path

from megastep.agents.cli import evaluate, record, train

ROOT = Path(__file__).resolve().parents[2]
MAINS = {"train.py": train.main, "evaluate.py": evaluate.main, "record.py": record.main}


def code(text):
    """Returns the Python blocks of a page."""
    return re.findall(r"```python\n(.*?)```", text, re.S)


def commands(text):
    """Returns the commands of a page, (script, words) each, in order."""
    lines = re.findall(r"^python (\S+) (.*)$", text, re.M)
    return [(script, shlex.split(words, comments=True)) for script, words in lines]


def few(script, words):
    """Returns a command's words with few samples or frames."""
    budget = "more_samples" if any(word.startswith("resume=") for word in words) else "samples"
    fewer = {"train.py": [f"{budget}=10000"], "record.py": ["steps=20"]}.get(script, [])
    replaced = "samples=", "more_samples=", "steps="
    return [word for word in words if not word.startswith(replaced)] + fewer


@contextlib.contextmanager
def inside(folder, patch):
    """Changes to a folder; forgets the modules imported from it afterwards."""
    patch.chdir(folder)
    patch.syspath_prepend(folder)
    yield
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None)).startswith(str(folder)):
            del sys.modules[name]


def type_all(text, folder, patch):
    """Runs the commands of a page in a folder; they must succeed. Returns the scripts."""
    with inside(folder, patch):
        for script, words in commands(text):
            assert MAINS[script](few(script, words)) == 0, (script, words)
    return [script for script, _ in commands(text)]
