"""Runs in environments of Gymnasium, from the command line."""

import json

import pytest

from megastep.agents.cli import evaluate, sweeps, train
from megastep.agents.cli.command import load
from megastep.agents.cli.compose import Composer
from megastep.agents.runs import json_lines
from tests.helpers import tiny

pytest.importorskip("gymnasium")
pytestmark = pytest.mark.usefixtures("here")
WORDS = [
    *("env=gymnasium", "device=cpu", "env.n_envs=4", "agent.width=8"),
    *("learner.n_steps=8", "learner.n_minibatches=2", "samples=64", "logging.every=1"),
]


@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_few_environments_unless_told_otherwise(device):
    words = ["env=gymnasium", f"device={device}"]
    assert tiny.settings(*words).env.n_envs <= 64 < tiny.settings(words[1]).env.n_envs
    assert tiny.settings(*words, "env.n_envs=16").env.n_envs == 16
    assert tiny.settings(*words).agent.encoder == "cnn"


def test_settings():
    words = ["env.id=minigrid:MiniGrid-Empty-5x5-v0", "env.kwargs.size=9", "env.wrappers=[a.b:C]"]
    env = tiny.settings("env=gymnasium", *words).env
    assert (env.id, env.kwargs, env.wrappers) == (words[0][7:], {"size": 9}, ("a.b:C",))
    composer = Composer(load("train"))
    jobs, *_ = sweeps.jobs_of(composer, ["env=gymnasium", "env.id=CartPole-v1,ALE/Pong-v5"])
    assert [composer.settings(job).env.id for job in jobs] == ["CartPole-v1", "ALE/Pong-v5"]


def test_train_evaluate_and_resume_exactly(here):
    """Frozen Lake holds an array of characters, and has a number in its last info."""
    words = [*WORDS, "env.id=FrozenLake-v1", "learner.anneal=never"]
    words += ["evaluation.every=32", "evaluation.episodes=8"]
    assert train.main([*words, "folder=run"]) == 0
    assert evaluate.main(["run=run", "episodes=8"]) == 0
    (table,) = here.glob("run/evaluations/FrozenLake-v1-*.json")
    rows = json.loads(table.read_text())["rows"]
    assert [row["lanes"] for row in rows] == [8, 8] and "prob" in rows[0]["metrics"]
    assert train.main(["resume=run", "more_samples=64"]) == 0
    assert train.main([*words, "samples=128", "folder=alone"]) == 0
    runs = [(here / name / "metrics.jsonl").read_bytes() for name in ("run", "alone")]
    assert runs[0] == runs[1]


def test_resumed_processes_begin_new_episodes(here, capsys):
    words = [*WORDS, "env.id=CartPole-v1", "env.vectorization=async", "folder=run"]
    assert train.main([*words, "env.n_envs=2", "samples=32"]) == 0
    assert "Checkpoints cannot hold" not in capsys.readouterr().err
    assert train.main(["resume=run", "more_samples=16"]) == 0
    assert "environments were not saved, so new episodes start" in capsys.readouterr().out
    samples = [row["samples"] for row in json_lines.read(here / "run/metrics.jsonl")]
    assert samples == [16, 32, 48]


def test_weights_of_another_environment_are_refused_by_its_name(capsys):
    assert train.main([*WORDS, "env.id=CartPole-v1", "folder=run"]) == 0
    assert train.main([*WORDS, "env.id=Acrobot-v1", "init=run"]) == 2
    text = capsys.readouterr().err
    assert "in another environment, CartPole-v1 and not Acrobot-v1: obs was MultiVector(" in text


@pytest.mark.parametrize(
    "words, text",
    [
        (["env.id=CartPol-v1"], "did you mean CartPole-v1?"),
        ([], "env.id is missing; name an environment"),
        (["env.kwargs=3"], "env.kwargs: expected keys with values, got 3"),
        (["env.wrappers=a"], "env.wrappers: 'a' is not a wrapper; there are "),
        (["env.vectorization=syn"], "did you mean sync?"),
    ],
)
def test_bad_input_leaves_nothing(here, words, text, capsys):
    assert train.main([*WORDS, *words]) == 2
    assert text in capsys.readouterr().err and not [*here.glob("runs/*")]


def test_value_outside_its_space_is_named(here, capsys):
    """And everything is saved, as for any failure of an environment."""
    words = [*WORDS, "env.id=tests.helpers.learning_wrappers:Seven-v0", "folder=run"]
    assert train.main(words) == 4
    error = capsys.readouterr().err
    assert "Seven-v0: an observation is not in its space: it has 7 in lane 0" in error
    assert "Discrete(4)" in error and "env.check=false" in error
    assert "Traceback" not in error
