"""The page on worlds: its commands can be typed, its pictures are there, its rules hold."""

import re
import shlex
from pathlib import Path

import pytest

from megastep import envs
from tests.helpers.tiny import SCRIPTS, settings

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "worlds.md").read_text()
COMMANDS = re.findall(r"^python (\w+)\.py ([^#\n]*)", PAGE, re.MULTILINE)


@pytest.mark.parametrize("script, arguments", [c for c in COMMANDS if c[0] in SCRIPTS])
def test_a_command_is_a_configuration(script, arguments):
    assert isinstance(settings(*shlex.split(arguments), script=script), SCRIPTS[script].kind)


def test_pictures_are_there_and_every_environment_is_told_of():
    pictures = re.findall(r"!\[[^]]+\]\(([^)]+)\)", PAGE)
    assert len(pictures) >= 4 and all((DOCS / name).exists() for name in pictures)
    assert set(envs.ENVS) <= set(map(str.lower, re.findall(r"^## (\w+)$", PAGE, re.MULTILINE)))
