"""The generated reference: everything has a description and a place, and the site builds."""

import json
import re

import docstrings
import pytest
import reference

from megastep import envs, toys
from megastep.agents import errors
from megastep.agents.cli import train
from megastep.agents.launch import endings
from tests.helpers.pages import ROOT
from tests.helpers.tiny import TINY

DOCS = ROOT / "docs"


def test_public_names_are_described_and_on_a_page():
    assert docstrings.undescribed() == []
    pages = "".join(path.read_text() for path in DOCS.glob("reference/api-*.md"))
    roots = tuple(re.findall(r"\{generated\} api (\S+)", pages))
    names = [module.__name__ for module in docstrings.modules() if docstrings.public(module)]
    assert [n for n in names if not f"{n}.".startswith(tuple(f"{root}." for root in roots))] == []


def test_settings_are_described():
    assert reference.unexplained() == []


def test_settings_say_what_applies():
    """On both devices, from the constructor, from configs/ and from nested settings."""
    rows = {row.key: row for row in reference.settings_of("learner", "r2d2")}
    assert rows["`learner.lr`"][1:4] == (
        "number or schedule, above 0 to 1,000,000",
        "0.001",
        "0.0005",
    )
    capacity = rows["`learner.replay.capacity`"]
    assert capacity[1:4] == ("integer, from 1 to 10^12", "8,000,000", "100,000")
    rows = {row.key: row for row in reference.settings_of("env", "explorer")}
    assert (
        rows["`env.n_envs`"][2:4] == ("4,096", "256") and rows["`env.resample`"].default == "true"
    )
    rows = {row.key: row for row in reference.settings_of("env", "pettingzoo")}
    assert rows["`env.n_envs`"][2:4] == ("16", "")  # the file that it begins with has 32
    rows = {row.key: row for row in reference.settings_of_script("train")}
    assert rows["`logging.every`"][2:] == ("100", "4", "updates between two lines of metrics")


@pytest.mark.parametrize(
    "name", ["deathmatch", "explorer", "hideandseek", "keys", "memory", "pointgoal", "pong"]
)
def test_metrics_of_environments_are_described(name):
    plans = {} if name in ("hideandseek", "keys", "pong") else {"geometries": [toys.box()]}
    world = envs.ENVS[name](2, device="cpu", **plans).reset()
    assert {*world.metrics} == {*docstrings.described(envs.ENVS[name], "Metrics")}


def test_metrics_and_files_of_a_run_are_described(here):
    """Those of a learner are in tests/algorithms/test_learners.py."""
    words = "opponents.past=0.25", "opponents.bot=0.25", "opponents.snapshots=1", "logger=csv"
    small = [word for word in TINY if not word.startswith(("geometry", "env.res"))]
    words = *small, "env=pong", "env.self_play=true", "env.points=1", "samples=1000", *words
    words = *words, "folder=run"
    assert train.main([*words]) == 0
    lines = [(here / "run" / f"{name}.jsonl").read_text() for name in ("metrics", "perf")]
    names = {name for line in "".join(lines).splitlines() for name in json.loads(line)}
    assert [name for name in sorted(names) if not reference.has_metric(name)] == []
    page = (DOCS / "reference" / "files.md").read_text()
    files = [path.name + "/" * path.is_dir() for path in (here / "run").iterdir()]
    assert [name for name in files if f"`{name}`" not in page] == []


def test_an_unknown_metric_is_found():
    assert reference.has_metric("episode/return/past") and reference.has_metric("loss/replayed_kl")
    assert not reference.has_metric("loss/kl_max") and not reference.has_metric("perf/idle")


def test_exit_codes_are_described():
    kinds = [errors.UserError, *errors.UserError.__subclasses__()]
    assert {0, endings.LOST, *(kind.code for kind in kinds)} <= {*errors.EXIT_CODES}
