"""Runs that strangers have made: links out of them, special files, odd contents."""

import os
import shutil
import socket
import time
from pathlib import Path

import pytest

from megastep.agents.cli import evaluate, inspect, train
from megastep.agents.errors import UserError
from tests.helpers.tiny import TINY, UPDATE

COMMANDS = [
    (train.main, ["resume=run", f"more_samples={UPDATE}"]),
    (evaluate.main, ["run=run", "episodes=2"]),
    (inspect.main, ["run"]),
]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert train.main([*TINY, f"samples={2 * UPDATE}", "folder=run"]) == 0
    return folder / "run"


@pytest.fixture
def run(trained, tmp_path, monkeypatch):
    """Changes to a folder with a copy of a run, beside which another folder is."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(trained, "run")
    Path("mine").mkdir()
    Path("mine/file").write_text("mine")
    return Path("run")


def outcome(main, words, capsys):
    """Returns the exit code of a command, and what it printed."""
    try:
        code = main(words)
    except UserError as error:  # of inspect, whose caller prints it
        code, _ = error.code, print(error)
    return code, "".join(capsys.readouterr())


def refused(capsys, *texts, commands=COMMANDS):
    """Each command ends within a second with one sentence that has these texts."""
    for main, words in commands:
        began = time.monotonic()
        code, err = outcome(main, words, capsys)
        assert code in (1, 2) and all(text in err for text in texts), (code, err)
        assert err.count("\n") == 1 and "Traceback" not in err, err
        assert time.monotonic() - began < 5, "and is not read"


NAMES = ["curves.png", "provenance.jsonl", "perf.jsonl", "annealing.f64", "lock", "config.yaml"]
NAMES += ["tensorboard", "checkpoints", "evaluations", "checkpoints/step_64/state.pt"]


@pytest.mark.parametrize("name", NAMES)
def test_a_link_that_leaves_the_run_is_refused_and_nothing_is_written_through_it(run, name, capsys):
    path, target = run / name, Path("mine/file").absolute()
    if path.is_dir():
        target = Path("mine/folder").absolute()
        shutil.move(path, target)
    elif path.exists():
        shutil.move(path, target)
    before = [(p, p.stat().st_mtime_ns) for p in sorted(Path("mine").rglob("*"))]
    path.parent.mkdir(exist_ok=True)
    path.symlink_to(target)
    refused(capsys, f"run/{name}", "link that leaves the run")
    assert [(p, p.stat().st_mtime_ns) for p in sorted(Path("mine").rglob("*"))] == before


def test_a_link_inside_a_run_and_a_link_to_it_are_none_of_these(run, capsys):
    (run / "newest").symlink_to("checkpoints/step_64")
    Path("mine/run").symlink_to(run.absolute())
    assert evaluate.main(["run=mine/run", "episodes=2", "baseline=false"]) == 0


def plant(path, kind):
    """Puts a special file in the place of a file."""
    path.unlink(missing_ok=True)
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "socket":
        here = os.getcwd()
        os.chdir(path.parent)  # the name of a socket is short
        socket.socket(socket.AF_UNIX).bind(path.name)
        os.chdir(here)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.mkdir()


FILES = ["metrics.jsonl", "curves.png", "checkpoints/step_64/manifest.json"]


@pytest.mark.parametrize("name", [*FILES, "checkpoints/step_64/config.json"])
@pytest.mark.parametrize("kind", ["fifo", "socket", "device"])
def test_a_special_file_in_a_run_is_refused_before_it_is_read(run, name, kind, capsys):
    plant(run / name, kind)
    refused(capsys, f"run/{name}")


@pytest.mark.parametrize("kind", ["fifo", "device", "folder"])
def test_a_special_file_in_place_of_an_argument_is_refused(kind, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    paths = [Path("a.safetensors"), Path("a.npz"), Path("a")]
    for path in paths:
        plant(path, kind)
    words = [["run=a.safetensors"], ["run=a"]]
    commands = [(evaluate.main, one) for one in words] + [(inspect.main, ["a.safetensors"])]
    commands += [(train.main, [*TINY, "geometry=files", "geometry.path=a.npz"])]
    commands += [(train.main, [*TINY, "env=explorer", "geometry=suite", "geometry.plans=a.npz"])]
    if kind != "folder":
        commands += [(train.main, [*TINY, "folder=a"])]
    for main, one in commands:
        began = time.monotonic()
        code, err = outcome(main, one, capsys)
        assert code == 2 and "Traceback" not in err, (one, err)
        assert time.monotonic() - began < 5, one
