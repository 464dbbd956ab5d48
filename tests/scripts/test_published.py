"""The benchmark of tasks with published results: what it reads from run folders, and a tiny run."""

import json
import os
from pathlib import Path

import benchmark
import figures
import plain_evaluation
import published
import pytest
import torch
import training_runs

CPU = torch.device("cpu")
POPGYM = published.TASKS["popgym-AutoencodeEasy-v0"]


def write_run(folder, returns):
    """Writes the metrics of a run with a report of 100 episodes every 10 samples."""
    folder.mkdir()
    rows = [
        {"samples": 10 * i, "episode/return": value, "episode/window": 100 + i}
        for i, value in enumerate(returns, 1)
    ]
    perf = [{"samples": row["samples"], "perf/seconds": row["samples"] / 5} for row in rows]
    for name, lines in ("metrics.jsonl", rows), ("perf.jsonl", perf):
        (folder / name).write_text("".join(json.dumps(line) + "\n" for line in lines))


def test_peak_is_the_largest_mean_return_of_a_report(tmp_path):
    write_run(tmp_path / "run", [-0.5, 0.25, 0.1])
    run = published.Run("popgym-AutoencodeEasy-v0", "gru", 1, tmp_path / "run")
    row = published.measured(run, CPU)
    assert row["value"] == 0.25 and row["peak_samples"] == 20 and row["episodes"] == 102
    assert row["samples"] == 30 and row["curve"][-1] == [6.0, 30, 0.1]


def test_run_without_an_episode_has_no_measurement(tmp_path):
    write_run(tmp_path / "run", [])
    run = published.Run("popgym-AutoencodeEasy-v0", "gru", 1, tmp_path / "run")
    assert published.measured(run, CPU) is None


def test_folders_that_exist_are_measured_and_not_trained(tmp_path, monkeypatch):
    monkeypatch.setattr(published.importlib.metadata, "version", lambda name: "1.0")
    for core, peak in zip(POPGYM.cores, (0.5, 0.4, 0.3, -0.5)):
        write_run(tmp_path / f"popgym-AutoencodeEasy-v0-{core}-1", [peak, -1.0])
    options = dict(tasks=["popgym-AutoencodeEasy-v0"], folder=tmp_path, jobs=2)
    rows = list(benchmark.measure("published", CPU, "abc", options))
    assert [row["value"] for row in rows] == [0.5, 0.4, 0.3, -0.5]
    assert rows[1]["what"] == "popgym-AutoencodeEasy-v0, gru: largest mean return in training"
    assert rows[0]["versions"] == {"gymnasium": "1.0", "popgym": "1.0"}
    words = "benchmark.py published --tasks popgym-AutoencodeEasy-v0 --jobs 2 --device cpu"
    assert rows[0]["command"] == f"python scripts/benchmarks/{words}"  # others have other folders


def test_interval_spans_those_of_the_seeds(monkeypatch):
    monkeypatch.setattr(published.importlib.metadata, "version", lambda name: "1.0")
    rows = {
        published.Run("CartPole-v1", "none", seed, Path()): dict(
            value=value, lower=value - 10, upper=value + 5, episodes=200
        )
        for seed, value in ((1, 480.0), (2, 490.0))
    }
    row = published.summary(rows)
    assert (row["value"], row["lower"], row["upper"], row["n"]) == (485, 470, 495, 400)


def test_jobs_share_the_cores_evenly(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(6)), raising=False)
    assert published.core_sets(3) == [[0, 1], [2, 3], [4, 5]]
    assert published.core_sets(8) == [[0], [1], [2], [3], [4], [5], [0], [1]]


def test_figure_has_a_line_per_seed_and_the_target(tmp_path):
    seeds = [dict(curve=[[1.0, 10, 20.0], [2.0, 20, value]]) for value in (400.0, 500.0)]
    record = dict(benchmark="published", what="CartPole-v1, none: return", target=475, seeds=seeds)
    record |= dict(on="CPU", date="2026-01-01")
    figures.plot_published([record], tmp_path / "published.svg")
    drawn = (tmp_path / "published.svg").read_text()
    assert "CartPole-v1" in drawn and drawn.count("none") >= 1 and "million samples" in drawn


@pytest.mark.slow
def test_plain_evaluator_agrees_with_evaluate(tmp_path):
    pytest.importorskip("gymnasium")
    # briefly, so that the policy neither fails at once nor balances until the end
    words = "env=gymnasium env.id=CartPole-v1 agent.core=none samples=6144 logging.every=1"
    with training_runs.trained(CPU, tuple(words.split())) as (run,):
        options = "episodes=256", "greedy=true", "baseline=false"
        row = training_runs.evaluate(run, CPU, *options)[0]
        returns = torch.tensor(plain_evaluation.returns(run, n_episodes=64, seed=5000))
    errors = returns.std() / 8, (row["upper"] - row["lower"]) / 4  # standard errors of both means
    assert abs(returns.mean() - row["return"]) <= 4 * torch.tensor(errors).norm()
    assert 9 < returns.mean() < 500
