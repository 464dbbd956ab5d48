"""Workflows of GitHub call make targets that exist."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))
TARGETS = set(re.search(r"^\.PHONY: (.*)", (ROOT / "Makefile").read_text(), re.M)[1].split())


def commands(job):
    """Returns the shell commands of a job, for each value of its matrix."""
    matrix = job.get("strategy", {}).get("matrix", {})
    rows = [{key: value} for key in matrix if key != "include" for value in matrix[key]]
    commands = []
    for step in job["steps"]:
        for row in [*rows, *matrix.get("include", [])] or [{}]:
            command = step.get("run", "")
            for key, value in row.items():
                command = command.replace(f"${{{{ matrix.{key} }}}}", value)
            commands.append(command)
    return commands


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_make_targets_and_scripts_exist(path):
    called = set()
    for job in yaml.safe_load(path.read_text())["jobs"].values():
        for command in commands(job):
            called.update(re.findall(r"\bmake ([\w-]+)", command))
            for script in re.findall(r"python (scripts/\S+)", command):
                assert (ROOT / script).is_file()
    assert called <= TARGETS


def test_all_of_ci_runs_on_github_too():
    lines = re.findall(r"^[^#\n]*make (.*)", (ROOT / ".ci/run").read_text(), re.M)
    targets = {word for line in lines for word in line.split() if word[0] != "-"}
    matrix = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())
    assert targets <= {*matrix["jobs"]["make"]["strategy"]["matrix"]["target"]}


@pytest.mark.skipif(not shutil.which("actionlint"), reason="actionlint is not installed")
def test_actionlint_finds_nothing():
    result = subprocess.run(["actionlint"], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout
