"""README and docs/: links and images exist, commands compose, environments have sections."""

import functools
import re
import shlex

import pytest
import reference

from tests.helpers.pages import MAINS, ROOT

DOCS = ROOT / "docs"
NAMES = "lab", "decisions", "reference", "tutorials", "notebooks", "concepts"
FOLDERS = DOCS, *(DOCS / name for name in NAMES)
PAGES = [page for folder in (ROOT, *FOLDERS) for page in folder.glob("*.md")]
# Commands that need a run, or files that a reader writes, are not composed here.
NEEDS_FILES = (
    r"resume=|rerun=|init=|my_package|cores:|encoders:|my_a2c:|safe:|rover:|convoy:|my_rooms:|my_grids:|my_sqlite:"
    r"|my_callbacks:|run=RUN|RUN/|my_ppo:|my_schedules:|my_wrappers:|waypoint:|drawn:|flat\.npz"
    r"|--config-dir"
)


def commands():
    """Returns (page, script, arguments) of every command on a line of its own."""
    for page in PAGES:
        text = page.read_text().replace("\\\n", " ")
        for script, arguments in re.findall(r"^python (\w+\.py) (.*)", text, re.M):
            if script in MAINS and not re.search(NEEDS_FILES, arguments):
                yield page.name, script, re.sub(r" +# .*", "", arguments)


@pytest.mark.parametrize(
    "page, script, arguments",
    [
        pytest.param(*command, marks=[] if command[0] == "README.md" else pytest.mark.slow)
        for command in commands()
    ],
)
def test_command_composes(page, script, arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code = MAINS[script]([*shlex.split(arguments), "--cfg", "job"])
    assert code == 0, capsys.readouterr().err


@functools.cache
def headings(page):
    """Returns a page's anchors as GitHub names them."""
    titles = re.findall(r"^#+ (.*)", reference.expand(page.read_text()), re.M)
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
