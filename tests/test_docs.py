"""README and docs/: links and images exist, commands compose, and every environment has a section."""

import re
import shlex
from pathlib import Path

import pytest

from megastep import envs
from megastep.agents.cli import arena
from megastep.agents.cli.build import build
from megastep.agents.cli.compose import ConfigLoader
from megastep.agents.cli.settings import Evaluate, Record, Train

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [*ROOT.glob("*.md"), *DOCS.glob("*.md"), *DOCS.glob("lab/*.md")]
SCRIPTS = {"train": Train, "evaluate": Evaluate, "record": Record}
# Names of a reader's own, and options that are not overrides.
EXAMPLES = "my_package", "tracker", "cores:", "encoders:", "rover", "convoy", "runs/NAME", "--config"


def commands():
    """Returns (page, script, arguments) of every complete command that can be composed here."""
    for page in PAGES:
        text = page.read_text().replace("\\\n", " ")
        for script, words in re.findall(r"^python (\w+)\.py (.*)", text, re.M):
            words = re.sub(r" +# .*", "", words)
            if script in SCRIPTS and not any(name in words for name in EXAMPLES):
                yield page.name, script, words


@pytest.mark.parametrize("page, script, words", commands())
def test_command_composes(page, script, words):
    overrides = [word for word in shlex.split(words) if word not in ("-m", "--multirun")]
    if "-m" in words.split():
        overrides = [word.partition(",")[0] for word in overrides if not word.startswith("hydra")]
        overrides = [word for word in overrides if "(" not in word]
    if any(word.startswith(("resume=", "init=")) for word in overrides):
        overrides = [re.sub("^(resume|init)=.*", "seed=1", word) for word in overrides]
    overrides = [arena.listed(w) if script == "evaluate" and w.startswith("against=") else w for w in overrides]
    kind = SCRIPTS[script]
    with ConfigLoader(script, kind) as loader:
        assert isinstance(build(kind, loader.tree(overrides)), kind)


def headings(page):
    """Returns a page's anchors as GitHub names them."""
    titles = re.findall(r"^#+ (.*)", page.read_text(), re.M)
    return {re.sub(r"[^\w\- ]", "", title).strip().lower().replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_images_exist(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if target.startswith("http"):
            continue
        path, _, anchor = target.partition("#")
        place = (page.parent / path).resolve() if path else page
        assert place.exists(), target
        assert not anchor or anchor in headings(place), target


def test_every_environment_has_a_section():
    titles = re.findall(r"^## (\w+)$", (DOCS / "environments.md").read_text(), re.M)
    assert set(envs.ENVS) <= {title.lower() for title in titles}
