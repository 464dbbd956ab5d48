"""Evaluations while a run trains: evaluation.every=, evaluation.stop.return=."""

import json

import pytest

from megastep.agents.cli import train
from megastep.agents.distributed.ranks import ONE
from megastep.agents.evaluation import in_training
from megastep.agents.factory import settings as settings_module
from megastep.agents.runs import checkpoint
from tests.helpers.tiny import (
    ON_GPU,
    SHORT_EPISODES,
    TINY,
    UPDATE,
    UPDATE_ON_GPU,
    settings,
)

WORDS = [*TINY, *SHORT_EPISODES, "learner.anneal=never", "logger=none", "geometry=homes"]
EVERY = [f"evaluation.every={4 * UPDATE}", "evaluation.episodes=8"]


def lines_of(folder, name="metrics.jsonl"):
    return [json.loads(line) for line in (folder / name).read_text().splitlines()]


def without_evaluations(rows):
    return [{k: v for k, v in row.items() if not k.startswith("eval/")} for row in rows]


def test_evaluations_change_nothing_of_the_training(here):
    words = [*WORDS, "logging.every=2", f"samples={11 * UPDATE}"]
    plain = train.run(settings(*words, "folder=plain"))
    evaluated = train.run(settings(*words, *EVERY, "folder=evaluated"))
    rows = lines_of(evaluated)
    assert without_evaluations(rows) == lines_of(plain)
    at = [row["samples"] // UPDATE for row in rows if "eval/return" in row]
    assert at == [4, 8], "the first report after every fourth update"
    paths = checkpoint.list_checkpoints(evaluated / "checkpoints")
    scores = {path.name: checkpoint.read_manifest(path)["score"] for path in paths}
    returns = {f"step_{row['samples']}": row["eval/return"] for row in rows if "eval/return" in row}
    assert {name: score for name, score in scores.items() if score is not None}.items() <= (
        returns.items()
    )
    best = max(returns, key=returns.__getitem__)
    assert scores[best] == returns[best], "the best of the evaluated ones is kept"
    assert scores[f"step_{11 * UPDATE}"] is None


def test_resumed_run_evaluates_as_the_whole_one(here):
    words = [*WORDS, *EVERY, "logging.every=2"]
    whole = train.run(settings(*words, f"samples={11 * UPDATE}", "folder=whole"))
    half = train.run(settings(*words, f"samples={5 * UPDATE}", "folder=half"))
    train.run(settings(f"resume={half}", f"samples={11 * UPDATE}", "device=cpu"))
    assert (half / "metrics.jsonl").read_bytes() == (whole / "metrics.jsonl").read_bytes()


def test_run_ends_when_an_evaluation_reaches_its_stop(here, capsys):
    words = [
        *WORDS,
        *EVERY,
        "samples=1e9",
        "folder=run",
        "resume=auto",
        "evaluation.stop.return=-1000",
    ]
    assert train.main(words) == 0
    said = capsys.readouterr().out
    assert f"Trained {4 * UPDATE} samples in " in said
    assert "when an evaluation had return " in said and "(evaluation.stop.return=-1000)" in said
    (row,) = [row for row in lines_of(here / "run", "perf.jsonl") if "perf/seconds_to_stop" in row]
    assert row["samples"] == 4 * UPDATE and row["perf/seconds_to_stop"] == row["perf/seconds"]
    assert train.main(words) == 0
    assert "The run in run has already reached its stop." in capsys.readouterr().out
    higher = [word for word in words if "stop" not in word and "samples" not in word]
    assert train.main([*higher, "evaluation.stop.return=1e6", f"samples={6 * UPDATE}"]) == 0
    assert f"Trained {6 * UPDATE} samples" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words, text",
    [
        (
            ["evaluation.stop.return=1"],
            "evaluation.stop: needs evaluations in training",
        ),
        (["evaluation.every=5m"], "may be minutes or millions: write min or M"),
        (["evaluation.every=often"], "is neither samples, such as 1M, nor a time, such as 60s"),
        (["evaluation.every=0"], "is neither samples"),
        (
            [*EVERY, "evaluation.stop.returns=1"],
            "stop.returns: no evaluation here measures it",
        ),
        ([*EVERY, "evaluation.stop.return=high"], "evaluation.stop: expected a number, got 'high'"),
    ],
)
def test_stop_that_cannot_be(here, capsys, words, text):
    assert train.main([*WORDS, "samples=1", *words]) == 2
    assert text in capsys.readouterr().err and not [*here.glob("runs/*")]


@pytest.mark.parametrize(
    "given, is_meant",
    [
        ("1M", (1_000_000, "samples")),
        (2000, (2000, "samples")),
        (1e6, (1_000_000, "samples")),
        ("90s", (90.0, "seconds")),
        ("1h30min", (5400.0, "seconds")),
    ],
)
def test_intervals_of_samples_and_of_seconds(given, is_meant):
    assert settings_module.every(settings_module._every(given)) == is_meant


def test_each_evaluation_plays_the_same_episodes():
    cfg = settings(*WORDS, *EVERY, "samples=1")
    sample = in_training.factory.make_sample(
        cfg.env, in_training.factory.homes(cfg.env, cfg.geometry, "test"), seed=1, device="cpu"
    )
    measure = in_training.Evaluations(cfg, sample, sample.device, ONE).measure
    policy = in_training.factory.make_policy(cfg.agent, sample)
    first = measure(policy)
    assert measure(policy) == first and first.keys() >= {"return", "length"}


@pytest.mark.cuda
def test_evaluations_change_nothing_of_the_training_on_a_gpu(here):
    words = [*ON_GPU, f"samples={9 * UPDATE_ON_GPU}", "logging.every=2", "logger=none"]
    plain = train.run(settings(*words, "folder=plain"))
    every = [f"evaluation.every={2 * UPDATE_ON_GPU}", "evaluation.episodes=64"]
    evaluated = train.run(settings(*words, *every, "folder=evaluated"))
    rows = lines_of(evaluated)
    assert without_evaluations(rows) == lines_of(plain)
    assert sum("eval/return" in row for row in rows) >= 4
