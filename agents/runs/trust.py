"""The import paths in a run's configuration, and which of them may be imported.

Importing a module runs its code. megastep's own components may always be imported; any other only
if this user has trained with it before, or with `trust=true`. The paths that this user has trained
with are kept in `megastep/trusted` in `$XDG_CONFIG_HOME`, by default `~/.config`, one per line.
"""

import contextlib
import os
import re
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path

from megastep.agents.errors import UserError, shortened

#: Settings groups that may contain import paths.
GROUPS = ("env", "geometry", "agent", "learner", "opponents", "curriculum", "logger", "callbacks")
CURE = "; if you trust it, train, evaluate and record take trust=true"
#: Import paths of megastep's own components.
OWN = re.compile(
    r"megastep\.(envs|geometries|agents\.(algorithms|networks|selfplay|training))(\.\w+)*:\w+"
)


def foreign_names(config: Mapping) -> list[str]:
    """Returns the import paths in a configuration that are not megastep's own."""
    train, names = config.get("train"), set()
    stack = [train.get(group) for group in GROUPS] if isinstance(train, dict) else []
    while stack:
        value = stack.pop()
        if isinstance(value, (dict, list)):
            stack += [*value, *value.values()] if isinstance(value, dict) else value
        elif isinstance(value, str) and ":" in value and not OWN.fullmatch(value):
            names.add(value)
    return sorted(names)


def remember(names: Iterable[str]) -> None:
    """Keeps import paths that this user trains with. Warns if they cannot be kept."""
    try:
        if new := [name for name in untrusted(names) if name.isprintable()]:
            _file().parent.mkdir(parents=True, exist_ok=True)
            with open(_file(), "a") as file:
                file.write("".join(f"{name}\n" for name in new))
    except OSError as error:
        problem = f"{_file()} cannot be written ({error.strerror})"
        warnings.warn(f"{problem}, so whatever loads this run needs trust=true", stacklevel=2)


def untrusted(names: Iterable[str]) -> list[str]:
    """Returns the import paths that this user has not trained with yet."""
    known = []
    with contextlib.suppress(OSError):
        known = _file().read_text().splitlines()
    return [name for name in names if name not in known]


def check(config: Mapping, source: object, cure: str = CURE) -> None:
    """Raises UserError if a configuration in `source` names what may not be imported."""
    names = foreign_names(config)
    if names and (names := untrusted(names)):
        raise UserError(
            f"{source} would import {shortened(', '.join(names))}, which runs code outside "
            f"megastep that you have not trained with here{cure}"
        )


def _file() -> Path:
    base = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    return Path(base) / "megastep" / "trusted"
