"""docs/worlds.md: its commands are valid, its images exist, and it lists every environment."""

import re
import shlex
from pathlib import Path

import pytest

from megastep import envs
from megastep.agents.cli.build import build
from megastep.agents.cli.compose import ConfigLoader
from megastep.agents.cli.settings import Evaluate, Record, Train

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "worlds.md").read_text()
COMMANDS = re.findall(r"^python (\w+)\.py ([^#\n]*)", PAGE, re.MULTILINE)
SCRIPTS = {"train": Train, "evaluate": Evaluate, "record": Record}


@pytest.mark.parametrize("script, arguments", [c for c in COMMANDS if c[0] in SCRIPTS])
def test_commands_are_valid(script, arguments):
    with ConfigLoader(script, SCRIPTS[script]) as loader:
        kind = SCRIPTS[script]
        assert isinstance(build(kind, loader.tree(shlex.split(arguments))), kind)


def test_images_exist_and_every_environment_has_a_section():
    images = re.findall(r"!\[[^]]+\]\(([^)]+)\)", PAGE)
    assert len(images) >= 4 and all((DOCS / name).exists() for name in images)
    assert set(envs.ENVS) <= set(map(str.lower, re.findall(r"^## (\w+)$", PAGE, re.MULTILINE)))
