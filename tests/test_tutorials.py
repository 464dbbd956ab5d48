"""Every page of docs/tutorials/ and docs/concepts/ runs from top to bottom in an empty folder, as a
reader types it. A tutorial ends with a picture or a film.
"""

import importlib
import re
import shlex

import pytest
import torch

from tests.helpers import pages

DOCS = pages.ROOT / "docs"
FOLDER = DOCS / "tutorials"
PAGES = sorted(page.name for page in FOLDER.glob("*.md") if page.name != "index.md")
CONCEPTS = ["../performance.md"] + sorted(
    f"../concepts/{page.name}"
    for page in (DOCS / "concepts").glob("*.md")
    if "```python" in page.read_text()
)
#: Pages that take more than about three seconds on an idle core.
LONG = {"deathmatch.md", "egomotion.md", "explorer.md", "from-python.md", "keys-and-memory.md"}
LONG |= {
    "own-floor-plans.md",
    "scaling-out.md",
    "setting-up.md",
    "sweeps.md",
    "training.md",
    "waypoint.md",
    "web-page.md",
}
BLOCK = re.compile(r"(?:<!-- not run: (.+) -->\n)?```(\S*)[^\n]*\n(.*?)```", re.S)
FILE = re.compile(r"(?:#|//|<!--) (\S+\.(?:py|h|cpp|cu|svg))(?: -->)?\n")
TIERS = {True: pytest.mark.nightly, False: pytest.mark.slow}


def follow(page, folder, patch):
    """Writes the files of a page and runs its other blocks, in order. Returns its variables."""
    names = {"__name__": "__main__"}
    with pages.inside(folder, patch):
        for reason, language, body in BLOCK.findall((FOLDER / page).read_text()):
            file = FILE.match(body)
            if reason or language.startswith("{"):
                continue
            if file:
                path = folder / file[1]
                path.parent.mkdir(exist_ok=True)
                path.write_text(body)
            elif language == "python":
                exec(compile(body, page, "exec"), names)
            else:
                for line in body.splitlines():
                    program, *words = shlex.split(line)
                    assert program in ("python", "megastep"), f"{page}: {line} is not run; say why"
                    name = words[0].removesuffix(".py")
                    main = importlib.import_module(f"megastep.agents.cli.{name}").main
                    assert main(words[1:]) == 0, line
    return names


@pytest.mark.parametrize("page", [pytest.param(p, marks=TIERS[p in LONG]) for p in PAGES])
def test_page_runs_and_draws_its_picture(page, tmp_path, monkeypatch):
    follow(page, tmp_path, monkeypatch)
    last = re.findall(r"\S*\.(?:png|svg|mp4|gif|html)\b", blocks(page)[-1])
    assert last, "the last block makes no picture"
    (made,) = tmp_path.rglob(last[-1].strip("\"'()").rpartition('"')[2].rpartition("=")[2])
    assert made.stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.parametrize("page", CONCEPTS)
def test_page_of_a_concept_runs(page, tmp_path, monkeypatch):
    follow(page, tmp_path, monkeypatch)


@pytest.mark.slow
def test_cuda_of_the_page_on_kernels_has_the_bits_of_its_cpp(tmp_path, monkeypatch, cuda_on_cpu):
    page = (FOLDER / "own-kernels.md").read_text()
    for _, _, body in BLOCK.findall(page):
        if file := FILE.match(body):
            (tmp_path / file[1]).parent.mkdir(exist_ok=True)
            (tmp_path / file[1]).write_text(body)
    positions = 3 * torch.rand(70, 2, generator=torch.Generator().manual_seed(1))
    with pages.inside(tmp_path, monkeypatch):
        trails = importlib.import_module("trails")
        painted = [torch.zeros(70, 50, 60, dtype=torch.uint8) for _ in range(2)]
        expected = trails.paint(positions, painted[0])
        cuda_on_cpu.launched.clear()
        monkeypatch.setattr(trails, "launch", cuda_on_cpu)
        found = trails.paint(positions, painted[1])
    assert cuda_on_cpu.launched == {"paint"} and expected.sum() > 500
    assert torch.equal(found, expected) and torch.equal(*painted)


def blocks(page):
    """Returns the blocks of a page that are run and are not files."""
    found = BLOCK.findall((FOLDER / page).read_text())
    return [body for reason, _, body in found if not reason and not FILE.match(body)]
