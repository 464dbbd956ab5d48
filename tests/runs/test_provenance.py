"""What a run says about the code, the machine and the command that made it."""

import os
import subprocess
import sys

import pytest
import torch

from megastep.agents import package
from megastep.agents.runs import json_lines, provenance

CPU = torch.device("cpu")


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A git checkout with one commit, and the hash of that commit."""
    monkeypatch.setenv("GIT_DIR", str(tmp_path))  # as in a hook of another repository
    env = {k: v for k, v in os.environ.items() if not k.startswith("GIT_")}

    def git(*words):
        who = "-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"
        command = ["git", "-C", str(folder), *who, *words]
        return subprocess.run(
            command, check=True, capture_output=True, text=True, env=env
        ).stdout.strip()

    folder = tmp_path / "checkout"
    (folder / "inner").mkdir(parents=True)
    (folder / "file").write_text("1")
    git("init")
    git("add", ".")
    git("commit", "-m", "first")
    return folder, git("rev-parse", "HEAD")


def test_commit_says_whether_the_checkout_has_changed(checkout):
    folder, commit = checkout
    assert provenance.commit(folder) == commit
    (folder / "new").write_text("2")
    assert provenance.commit(folder) == commit, "as for git describe, new files are not a change"
    (folder / "file").write_text("2")
    assert provenance.commit(folder) == f"{commit}-dirty"


def test_only_a_checkout_of_its_own_has_a_commit(checkout, tmp_path, monkeypatch):
    folder, _ = checkout
    assert provenance.commit(folder / "inner") is None, "it may be somebody else's project"
    assert provenance.commit(tmp_path) is None and provenance.commit(tmp_path / "absent") is None
    monkeypatch.setenv("PATH", "")  # no git
    assert provenance.commit(folder) is None


def test_each_start_of_a_run_is_a_line(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "orig_argv", ["python", "train.py", "folder=two words"])
    monkeypatch.setattr(package, "version", lambda: "megastep 9.9")
    monkeypatch.setattr(provenance, "commit", lambda path: path.name)
    for samples in (0, 640):
        provenance.record(tmp_path, samples, CPU)
    rows = json_lines.read(tmp_path / "provenance.jsonl")
    assert [row["samples"] for row in rows] == [0, 640]
    row = rows[1]
    assert row["command"] == "python train.py 'folder=two words'"
    assert (row["commit"], row["megastep"]) == (package.ROOT.name, "megastep 9.9")
    assert row["torch"] == torch.__version__ and row["device"].startswith("cpu ")
    assert row["python"] == ".".join(map(str, sys.version_info[:3])) and "T" in row["time"]


def test_no_failure_ends_a_run(tmp_path, monkeypatch):
    provenance.record(tmp_path / "absent", 0, CPU)

    def failing(*_, **__):
        raise RuntimeError

    monkeypatch.setattr(provenance, "made_with", failing)
    provenance.record(tmp_path, 0, CPU)
