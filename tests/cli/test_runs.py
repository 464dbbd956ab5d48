"""Run folders: new ones, existing ones by name, and their locks."""

import errno
import fcntl
import os
import pathlib
import shutil
import subprocess
import sys

import pytest

from megastep.agents.cli.command import load
from megastep.agents.cli.compose import Composer
from megastep.agents.cli.words import typed_word
from megastep.agents.errors import UserError
from megastep.agents.runs import folders
from megastep.agents.runs.folders import locked
from tests.helpers.processes import ROOT

pytestmark = pytest.mark.usefixtures("here")


def run(name):
    """Makes a run folder with a folder of checkpoints and records its start."""
    path = pathlib.Path(name)
    (path / "checkpoints").mkdir(parents=True)
    folders.record_start(path)
    return path


def test_make_numbers_taken_names():
    paths = [folders.make(pathlib.Path("runs/a")) for _ in range(3)]
    assert [str(path) for path in paths] == ["runs/a", "runs/a-2", "runs/a-3"]


@pytest.mark.parametrize(
    "name", ["runs/2026-1-1_a-b", "r n ü", 'a"b', "a\\b", "it's", "[x,y]={$HOME}"]
)
def test_resume_command_is_quoted(name):
    typed = subprocess.run(
        ["bash", "-c", f"printf '%s\\n' {folders.resume_command(pathlib.Path(name))}"],
        text=True,
        stdout=subprocess.PIPE,
    )
    python, script, override = typed.stdout.splitlines()
    composer = Composer(load("train"))
    config, errors = composer.config([*map(typed_word, composer.parse([override]))])
    assert (python, script, errors) == ("python", "train.py", [])
    assert config["resume"] == name


# ---- latest ----


def test_latest_is_started_last():
    first, second = run("runs/b"), run("runs/a")
    assert folders.find("latest") == second
    (first / "checkpoints" / "step_1").mkdir()
    (first / "evaluations").mkdir()
    assert folders.find("latest") == second
    folders.record_start(first)  # it goes on
    assert folders.find("latest") == first


def test_latest_after_copies_and_deletions():
    first, second, third = run("runs/2026-03-01-a"), run("runs/2026-01-01-b"), run("runs/c")
    for path in (first, second, third):
        os.utime(path / "checkpoints", (0, 0))
    shutil.copytree(first, "runs/z-copy")
    assert folders.find("latest") == third
    shutil.rmtree(third)
    assert folders.find("latest") == second
    shutil.rmtree("runs/2026-01-01-b")
    assert folders.find("latest") == first


def test_latest_without_records():
    for name in ("2026-01-02", "2026-01-01"):
        pathlib.Path("runs", name, "checkpoints").mkdir(parents=True)
    assert str(folders.find("latest")) == "runs/2026-01-02"
    known = run("runs/2025")
    assert folders.find("latest") == known


def test_run_that_was_killed_before_its_first_checkpoint():
    (folder := pathlib.Path("killed")).mkdir()
    (folder / "config.yaml").touch()
    with pytest.raises(UserError, match="killed has no checkpoint yet; wait for one, or"):
        folders.find("killed")


def test_unwritable_start_record_warns():
    pathlib.Path("runs").write_text("a file")
    with pytest.warns(match="^runs/started.txt cannot be written"):
        folders.record_start(pathlib.Path("elsewhere"))


# ---- The lock ----


def test_lock_names_the_process(here):
    with locked(here):
        assert (here / "lock").read_text() == str(os.getpid())
        with pytest.raises(
            UserError, match=f"in use by process {os.getpid()};.*kill {os.getpid()}"
        ):
            with locked(here):
                pass
        assert (here / "lock").read_text() == str(os.getpid()), "the refused one leaves it"
    assert not (here / "lock").exists()
    with locked(here):
        pass


HOLDS = """
import pathlib, sys
from megastep.agents.runs.folders import locked
with locked(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_lock_of_a_killed_process(here):
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDS, here],
        cwd=ROOT,
        text=True,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(UserError, match=f"process {holder.pid}"), locked(here):
        pass
    holder.kill()
    holder.communicate()
    assert (here / "lock").read_text() == str(holder.pid)
    with locked(here):
        assert (here / "lock").read_text() == str(os.getpid())


def test_file_system_without_locks(here, monkeypatch):
    def flock(file, how):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.warns(match="file system without locks"), locked(here):
        pass


@pytest.mark.parametrize(
    "begun, cure",
    [
        ("", "choose another with folder=: "),
        *((x, "resume a copy") for x in ("checkpoints", "member-0")),
    ],
)
def test_read_only_folder_names_what_helps(here, monkeypatch, begun, cure):
    def acquire(lock):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), lock.lock_file)

    (here / begun).mkdir(exist_ok=True)
    monkeypatch.setattr("filelock.FileLock.acquire", acquire)
    with pytest.raises(UserError, match=f"cannot be written.*{cure}.*Read-only"), locked(here):
        pass
