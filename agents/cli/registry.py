"""What a configuration can be made of: import paths, `module:attribute`, and the groups of configs/
whose members hold one. Ours and others' classes are found and read in the same way. Knows no Hydra.
"""

import dataclasses
import functools
import inspect
import json
from pathlib import Path
from typing import Any

import yaml
from pydantic import TypeAdapter

from megastep.agents.imports import import_object
from megastep.settings import closest, settings_of

#: configs/ of the repository, which the package has as its data.
CONFIGS = Path(__file__).resolve().parents[1] / "configs"


class Group:
    """A group whose member decides which settings there are: `name`, the import path of a class or
    a function, and the arguments of that. It may also be such a path itself.

    Args: `reserved`, arguments that a run gives; `needed`, those that must be there, with what they
    mean; `missing`, defaults of some that may have none; `more`, settings that every member has.
    """

    takes_imports = True

    def __init__(
        self,
        key: str,
        reserved: tuple = (),
        needed: dict | None = None,
        missing: dict | None = None,
        **more: Any,
    ):
        self.key, self.reserved, self.needed = key, reserved, needed or {}
        self.missing, self.more = missing, more
        self.kind = functools.cache(self._kind)

    def _kind(self, name: str) -> type:
        """The settings of the member with this import path, a dataclass; ValueError if there is
        none.
        """
        made = import_object(name)
        try:
            present = inspect.signature(made).parameters
            for argument, meaning in self.needed.items():
                if argument not in present:
                    raise ValueError(f"it takes no {argument}, {meaning}")
            return settings_of(made, self.reserved, self.missing, name=str, **self.more)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{name} cannot be used: {error}") from error

    def settings(self, value: Any) -> Any:
        """The member's settings from a dict, or as they are; ValueError otherwise."""
        if dataclasses.is_dataclass(value):
            return value
        if not isinstance(value, dict):
            raise ValueError(f"is a group of keys, got {value!r}")
        if "name" not in value:
            first = sorted((CONFIGS / self.key).glob("*.yaml"))[0].stem
            raise ValueError(f"keys of it need a member of it: give {self.key}= too, say {first}")
        return TypeAdapter(self.kind(str(value.get("name")))).validate_json(json.dumps(value))

    def having(self, key: str) -> str | None:
        """The first member in configs/ that has a setting called `key`."""
        for path in sorted((CONFIGS / self.key).glob("*.yaml")):
            name = yaml.safe_load(path.read_text())["name"]
            if key in self.kind(name).__pydantic_fields__:
                return path.stem
        return None


class Choice(Group):
    """A group whose members are dataclasses here, by name."""

    takes_imports = False

    def __init__(self, key: str, kinds: dict[str, type]):
        super().__init__(key)
        self.kinds = kinds

    def _kind(self, name):
        if name not in self.kinds:
            raise ValueError(f"{name!r} is unknown; {closest(name, self.kinds)}")
        return self.kinds[name]


def label(name: str) -> str:
    """An import path in short: `explorer` of megastep.envs.explorer:Explorer."""
    return name.rpartition(":")[2].rpartition(".")[2].lower()
