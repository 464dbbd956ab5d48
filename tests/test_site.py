"""The site, docs/: it builds without warnings, and its notebooks show what their text says."""

import json
import re

import pytest

from tests.helpers import pages

pytestmark = pytest.mark.filterwarnings("ignore:.*MystReferenceResolver")
DOCS = pages.ROOT / "docs"
FOLDER = "notebooks"


def outputs(folder, notebook):
    """Returns what a notebook of a site printed, and the numbers of its pictures and films."""
    path = folder / "jupyter_execute" / FOLDER / f"{notebook}.ipynb"
    cells = json.loads(path.read_text())["cells"]
    all_of = [output for cell in cells for output in cell.get("outputs", ())]
    text = "".join("".join(output.get("text", "")) for output in all_of)
    kinds = [kind for output in all_of for kind in output.get("data", ())]
    films = sum("<video" in "".join(o.get("data", {}).get("text/html", "")) for o in all_of)
    return text, kinds.count("image/png"), films


@pytest.mark.nightly
def test_site_builds_without_warnings_and_its_notebooks_show_what_they_say(tmp_path, monkeypatch):
    """All but the writing of HTML, which is half of the time: notebooks run, links and anchors are
    resolved.
    """
    from sphinx.cmd.build import build_main

    options = "-W", "--keep-going", "-q", "-E", "-b", "dummy", "-d", str(tmp_path / "doctrees")
    monkeypatch.setenv("MEGASTEP_REPOSITORY", "https://example.org/megastep")
    monkeypatch.setenv("PYTHONPATH", "")  # conf.py changes both, which is undone here
    monkeypatch.setenv("MPLBACKEND", "agg")
    assert build_main([*options, str(DOCS), str(tmp_path / "html")]) == 0
    an_expert_and_a_trained_agent_are_shown(*outputs(tmp_path, "quick-tour"))
    memory_of_a_trained_agent_knows_more_than_its_view(*outputs(tmp_path, "inside-an-agent"))


def an_expert_and_a_trained_agent_are_shown(text, n_pictures, n_films):
    by_chance, by_expert = map(int, re.findall(r"^(\d+) pieces of wall", text, re.M))
    assert by_expert > 3 * by_chance > 0
    assert (n_pictures, n_films) == (2, 2)  # a home and a curve; an expert and Pong


def memory_of_a_trained_agent_knows_more_than_its_view(text, n_pictures, _):
    scores = dict(re.findall(r"^(\w+) +which way +(\S+)", text, re.M))
    view, untrained, memory = (float(scores[name]) for name in ("view", "untrained", "memory"))
    assert memory > 0.1 + max(view, untrained)
    assert n_pictures == 2
