"""The reader of a run's `config.yaml`, which may be a stranger's."""

from pathlib import Path
from typing import Any

import yaml

from megastep.agents.errors import user_errors
from megastep.agents.runs import typed_json

#: Most bytes of the file.
MAX_BYTES = 100_000


class _Loader(yaml.SafeLoader):
    """Refuses aliases, which unfold, and integers that cannot be printed."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise ValueError("it has an alias")
        return super().compose_node(parent, index)

    def construct_yaml_int(self, node: Any) -> int:
        if abs(value := super().construct_yaml_int(node)) >= 2**64:
            raise ValueError("it has an integer beyond 64 bits")
        return value


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)


def read(path: Path) -> dict[str, Any]:
    """Returns the settings in a `config.yaml`. Raises UserError if it holds something else."""
    # Exception: whatever YAML makes of a tag that its text does not fit
    with user_errors(f"{path} does not hold the settings of a run: ", (Exception,)):
        with open(path, "rb") as file:
            text = file.read(MAX_BYTES + 1)
        if len(text) > MAX_BYTES:
            raise ValueError(f"it has more than {MAX_BYTES:,} bytes")
        config = yaml.load(text, _Loader)
        typed_json.check(typed_json.ConfigYaml, config)
        return config
