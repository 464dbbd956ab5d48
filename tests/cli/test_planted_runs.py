"""Runs that strangers have made: what their files say ends a command with one sentence, at most."""

import shutil
from pathlib import Path

import pytest
import torch

from megastep.agents.cli import evaluate, inspect, train
from megastep.agents.errors import UserError
from megastep.agents.runs import checkpoint
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
    """Changes to a folder with a copy of a run."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(trained, "run")
    return Path("run")


def outcome(main, words, capsys):
    """Returns the exit code of a command, and what it printed."""
    try:
        code = main(words)
    except UserError as error:  # of inspect, whose caller prints it
        code, _ = error.code, print(error)
    return code, "".join(capsys.readouterr())


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


def nested(n):
    tree = []
    for _ in range(n):
        tree = [tree]
    return tree


ODD = {
    "a list": lambda tree: tree | {"train": []},
    "no spaces": lambda tree: {"train": tree["train"]},
    "spaces of numbers": lambda tree: tree | {"spaces": {"obs": 3}},
    "spaces of code": lambda tree: tree | {"spaces": {**tree["spaces"], "actions": "exit()"}},
    "learner is text": lambda tree: changed(tree, "train.learner", "ppo"),
    "width is infinite": lambda tree: changed(tree, "train.agent.width", float("inf")),
    "environment is deep": lambda tree: changed(tree, "train.env.kwargs", nested(500)),
}


@pytest.mark.parametrize("change", ODD.values(), ids=ODD)
def test_an_odd_configuration_is_one_sentence(run, change, capsys):
    planted(run, change)
    for main, words in COMMANDS[:2]:
        code, text = outcome(main, words, capsys)
        assert code == 2 and "Traceback" not in text and text.count("\n") == 1, text
        assert "run" in text, text


STATES = {
    "no counts": lambda state: {k: v for k, v in state.items() if k != "updates"},
    "no policy": lambda state: {k: v for k, v in state.items() if k != "policy"},
    "a list": lambda state: state | {"policy": [1]},
    "no learner": lambda state: state | {"learner": {}},
    "no statistics": lambda state: state | {"episode_stats": 3},
}


@pytest.mark.parametrize("change", STATES.values(), ids=STATES)
def test_an_odd_state_is_one_sentence(run, change, capsys):
    planted(run, change_state=change)
    code, text = outcome(*COMMANDS[0], capsys)
    assert code == 2 and "Traceback" not in text and text.count("\n") == 1, text
    assert "run" in text, text


def test_a_record_of_other_learning_rates_is_refused(run, capsys):
    (run / "annealing.f64").write_bytes(8 * b"\x7f")
    for words in (COMMANDS[0][1], ["rerun=run"]):
        code, text = outcome(train.main, words, capsys)
        assert code == 2 and "annealing.f64 is damaged" in text and text.count("\n") == 1, text


def test_weights_of_another_type_are_one_sentence(run, capsys):
    planted(run, change_state=lambda state: state | {"policy": {"x": torch.ones(1)}})
    code, text = outcome(*COMMANDS[1], capsys)
    assert code == 2 and "needs an agent with" in text and text.count("\n") == 1
