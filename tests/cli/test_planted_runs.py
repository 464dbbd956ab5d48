"""Runs that strangers have made: links out of them, special files, odd contents."""

import hashlib
import json
import os
import shutil
import socket
import time
import zipfile
from pathlib import Path

import pytest
import torch

from megastep.agents.cli import evaluate, inspect, train
from megastep.agents.errors import UserError
from megastep.agents.runs import checkpoint, checkpoint_format
from tests.helpers.tiny import TINY, UPDATE, changed

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


# ---- Odd contents with the right SHA-256 ----


def planted(run, change_config=lambda tree: tree, change_state=lambda state: state):
    """Replaces the checkpoints of a run by one with another configuration and state."""
    loaded = checkpoint.load_latest(run / "checkpoints")
    shutil.rmtree(run / "checkpoints")
    config, state = change_config(loaded.config), change_state(loaded.state)
    checkpoint.save(run / "checkpoints", 2 * UPDATE, state, config)


@pytest.mark.parametrize("key", ["name", "spaces", "train"])
def test_control_characters_of_a_file_are_never_printed(run, key, capsys):
    evil = "\x1b]0;owned\x07\x9b31m\u202e\r"

    def change(tree):
        if key == "name":
            tree["train"]["env"]["name"] = f"megastep.envs.{evil}:A"
        elif key == "spaces":
            tree["spaces"] = {f"obs{evil}": evil}
        else:
            tree["train"][evil] = evil
        return tree

    planted(run, change)
    for main, words in COMMANDS:
        _, text = outcome(main, words, capsys)
        assert not {*evil} & {*text} - {"]", "0", ";", *"owned", *"31m"}, text


ODD = {
    "a list": lambda tree: tree | {"train": []},
    "no spaces": lambda tree: {"train": tree["train"]},
    "spaces of numbers": lambda tree: tree | {"spaces": {"obs": 3}},
    "learner is text": lambda tree: changed(tree, "train.learner", "ppo"),
    "samples are text": lambda tree: changed(tree, "train.samples", "many"),
    "width is infinite": lambda tree: changed(tree, "train.agent.width", float("inf")),
    "seed is huge": lambda tree: changed(tree, "train.seed", 10**400),
    "logger is null": lambda tree: changed(tree, "train.logger", None),
    "environment is deep": lambda tree: changed(tree, "train.env.kwargs", nested(500)),
}


def nested(n):
    tree = []
    for _ in range(n):
        tree = [tree]
    return tree


@pytest.mark.parametrize("change", ODD.values(), ids=ODD)
def test_an_odd_configuration_is_one_sentence(run, change, capsys):
    planted(run, change)
    for main, words in COMMANDS[:2]:
        code, text = outcome(main, words, capsys)
        assert code == 2 and "Traceback" not in text and text.count("\n") == 1, text
        assert "run" in text, text


def test_a_record_of_other_learning_rates_is_refused(run, capsys):
    (run / "annealing.f64").write_bytes(8 * b"\x7f")
    for words in (COMMANDS[0][1], ["rerun=run"]):
        code, text = outcome(train.main, words, capsys)
        assert code == 2 and "annealing.f64 is damaged" in text and text.count("\n") == 1, text


STATES = {
    "10^12 updates": lambda state: state | {"updates": 10**12},
    "no counts": lambda state: {k: v for k, v in state.items() if k != "updates"},
    "text": lambda state: state | {"samples": "64"},
    "no policy": lambda state: {k: v for k, v in state.items() if k != "policy"},
    "a list": lambda state: state | {"policy": [1]},
    "no learner": lambda state: state | {"learner": {}},
    "a NaN of the learner": lambda state: state | {"learner": {"w": torch.tensor(torch.nan)}},
    "no statistics": lambda state: state | {"episode_stats": 3},
    "a sparse weight": lambda state: state | {"policy": sparse(state["policy"])},
}


def sparse(weights):
    name = next(name for name, weight in weights.items() if weight.dim() == 2)
    return weights | {name: weights[name].to_sparse()}


@pytest.mark.parametrize("change", STATES.values(), ids=STATES)
@pytest.mark.filterwarnings("ignore:.*sparse")
def test_an_odd_state_is_one_sentence(run, change, capsys):
    planted(run, change_state=change)
    code, text = outcome(*COMMANDS[0], capsys)
    assert code == 2 and "Traceback" not in text and text.count("\n") == 1, text
    assert "run" in text, text


def test_a_compressed_state_is_refused(run, capsys):
    path = run / "checkpoints/step_64/state.pt"
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, part in parts.items():
            archive.writestr(name, part)
    manifest = json.loads(path.with_name("manifest.json").read_bytes())
    content = path.read_bytes()
    entry = {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
    manifest["files"]["state.pt"] = entry
    del manifest["sha256"]
    path.with_name("manifest.json").write_bytes(checkpoint_format.sealed(manifest))
    code, text = outcome(*COMMANDS[1], capsys)
    assert code == 2 and "its parts are compressed" in text, text
