"""The site, docs/: it builds without warnings, and its notebooks show what their text says."""

import json
import re

import pytest

from tests.helpers import pages

pytestmark = pytest.mark.filterwarnings("ignore:.*MystReferenceResolver")
DOCS = pages.ROOT / "docs"
FOLDER = "notebooks"
NOTEBOOKS = sorted(page.stem for page in (DOCS / FOLDER).glob("*.md"))


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The exit code of a build, and its folder. All but the writing of HTML, which is half of the
    time: notebooks run, links and anchors are resolved.
    """
    from sphinx.cmd.build import build_main

    folder = tmp_path_factory.mktemp("site")
    options = "-W", "--keep-going", "-q", "-E", "-b", "dummy", "-d", str(folder / "doctrees")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MEGASTEP_REPOSITORY", "https://example.org/megastep")
        patch.setenv("PYTHONPATH", "")  # conf.py changes both, which is undone here
        patch.setenv("MPLBACKEND", "agg")
        return build_main([*options, str(DOCS), str(folder / "html")]), folder


@pytest.fixture
def outputs(request, site):
    """What a notebook printed, and what its cells show: (text, kinds)."""
    path = site[1] / "jupyter_execute" / FOLDER / f"{request.param}.ipynb"
    cells = json.loads(path.read_text())["cells"]
    all_of = [output for cell in cells for output in cell.get("outputs", ())]
    text = "".join("".join(output.get("text", "")) for output in all_of)
    kinds = [kind for output in all_of for kind in output.get("data", ())]
    films = sum("<video" in "".join(o.get("data", {}).get("text/html", "")) for o in all_of)
    return text, kinds.count("image/png"), films


@pytest.mark.slow
def test_site_builds_without_warnings(site):
    assert site[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("outputs", ["quick-tour"], indirect=True)
def test_quick_tour_shows_an_expert_and_a_trained_agent(outputs):
    text, n_pictures, n_films = outputs
    by_chance, by_expert = map(int, re.findall(r"^(\d+) pieces of wall", text, re.M))
    assert by_expert > 3 * by_chance > 0
    assert (n_pictures, n_films) == (2, 2)  # a home and a curve; an expert and Pong


@pytest.mark.slow
@pytest.mark.parametrize("outputs", ["inside-an-agent"], indirect=True)
def test_memory_of_a_trained_agent_knows_more_than_its_view(outputs):
    text, n_pictures, _ = outputs
    scores = dict(re.findall(r"^(\w+) +which way +(\S+)", text, re.M))
    view, untrained, memory = (float(scores[name]) for name in ("view", "untrained", "memory"))
    assert memory > 0.1 + max(view, untrained)
    assert n_pictures == 2


def test_every_notebook_is_in_the_index():
    index = (DOCS / "tutorials" / "index.md").read_text()
    assert NOTEBOOKS and all(f"(../{FOLDER}/{name}.md)" in index for name in NOTEBOOKS)
