"""Benchmarks that train: what they read from run folders, and tiny runs of each."""

import figures
import pytest
import torch
import training_benchmarks
import training_runs

CPU = torch.device("cpu")


def test_learning_curve_joins_metrics_and_seconds(tmp_path):
    (tmp_path / "metrics.jsonl").write_text(
        '{"samples": 10, "lr": 1}\n{"samples": 20, "episode/return": 3.5}\n'
    )
    (tmp_path / "perf.jsonl").write_text(
        '{"samples": 10, "perf/seconds": 1.0}\n{"samples": 20, "perf/seconds": 2.0}\n'
    )
    assert training_runs.learning_curve(tmp_path) == [(2.0, 20, 3.5)]


def test_training_rate_is_median_between_points():
    curve = [(1.0, 0, 0.5), (2.0, 3_000_000, 1.23456), (3.0, 5_000_000, 2.0)]
    row = training_runs.training_rate("run", curve)
    assert row["what"] == "run, median rate" and row["value"] == 2.5
    assert row["curve"] == [[1.0, 0, 0.5], [2.0, 3_000_000, 1.235], [3.0, 5_000_000, 2.0]]


def test_metric_mean_has_interval_of_its_metric():
    metrics = {"spl": dict(mean=0.5, lower=0.4, upper=0.6)}
    row = {"return": 3.0, "lower": 2.0, "upper": 4.0, "metrics": metrics, "homes": 51, "lanes": 99}
    spl = training_runs.metric_mean("a", row, "spl")
    assert spl == dict(what="a", value=0.5, unit="", lower=0.4, upper=0.6, n=51)
    mean_return = training_runs.metric_mean("a", row | dict(homes=None), "return")
    assert mean_return == dict(what="a", value=3.0, unit="", lower=2.0, upper=4.0, n=99)


@pytest.mark.slow
def test_failing_run_raises():
    with pytest.raises(Exception, match="train.py"):
        with training_runs.trained(CPU, ("env=unknown",)):
            pass


@pytest.mark.nightly
def test_recipes_are_trained_and_evaluated_by_source(monkeypatch):
    pong = "env=pong samples=8192 env.n_envs=32 logging.every=1"
    pointgoal = "env=pointgoal samples=4096 env.n_envs=32 env.limit=16 env.res=64 logging.every=1"
    parts = "geometry.parts={dense:{source:homes,n:20},box:{n:1}}"
    recipes = {
        "Pong": (pong, "episodes=7"),
        "PointGoal": (pointgoal, f"geometry=suite {parts} episodes=20"),
    }
    monkeypatch.setattr(training_benchmarks, "RECIPES", recipes)
    rows = list(training_benchmarks.worlds(CPU))
    by_title = {title: [row for row in rows if row["what"].startswith(title)] for title in recipes}
    rate, *pong = by_title["Pong"]
    assert rate["unit"] == "M/s" and all(0 <= won <= 1 for _, _, won in rate["curve"])
    # two agents, two metrics
    assert len(pong) == 2 * 2 and {row["n"] for row in pong} == {7}
    assert sum(": points_won, " in row["what"] for row in pong) == 2
    assert sum(row["what"].endswith(", random") for row in pong) == 2
    rate, *pointgoal = by_title["PointGoal"]
    # two agents; two sources, the worst and the worst dense homes; four metrics and the return
    assert len(pointgoal) == 2 * 4 * 5 and rate["unit"] == "M/s"
    assert any(", in dense, worst 5 % of homes: spl, " in row["what"] for row in pointgoal)


@pytest.mark.slow
def test_train_evaluates_in_unseen_homes(monkeypatch):
    small = "env.n_envs=32", "logging.every=1", "finish.episodes=16"
    overrides = *training_benchmarks.EXPLORER, *small
    monkeypatch.setattr(training_benchmarks, "EXPLORER", overrides)
    rows = list(training_benchmarks.train(CPU, seeds=(1,), budgets=(2,)))
    assert [row["what"] for row in rows[:2]] == [
        "training, 2 s, seed 1, return in unseen homes",
        "training, 2 s, seed 1, return of random actions in unseen homes",
    ]


@pytest.mark.nightly
def test_deathmatch_runs_are_trained_side_by_side_and_duel(monkeypatch):
    small = "geometry=box", "env.n_envs=16", "logging.every=1", "desync=false"
    deathmatch = *training_benchmarks.DEATHMATCH, *small
    monkeypatch.setattr(training_benchmarks, "DEATHMATCH", deathmatch)
    monkeypatch.setattr(training_benchmarks, "ABLATIONS", {"one": "", "other": "env.fov=130"})
    monkeypatch.setattr(training_benchmarks, "N_SNAPSHOTS", 2)
    monkeypatch.setattr(training_benchmarks, "N_DUELS", 16)
    rows = list(training_benchmarks.duels(CPU, seeds=(1, 2), samples=32_768))
    for seed in (1, 2):
        names = [row["what"] for row in rows if f"seed {seed}" in row["what"]]
        assert len(names) == 6
        assert "against bot (" in " ".join(names) and "rating of bot" in " ".join(names)
    rows = list(training_benchmarks.ablation(CPU, samples=2048))
    assert len(rows) == 4 and all(0 <= row["value"] <= 1 for row in rows)


@pytest.mark.nightly
def test_learners_are_compared_and_drawn(monkeypatch, tmp_path):
    asynchronous = training_benchmarks.ASYNC  # skipped outside of Explorer
    titles = "PPO", "R2D2", asynchronous
    compared = {title: training_benchmarks.LEARNERS[title] for title in titles}
    monkeypatch.setattr(training_benchmarks, "LEARNERS", compared)
    overrides = "env=pong agent.core=none env.n_envs=64 logging.every=2"
    monkeypatch.setattr(training_benchmarks, "COMPARED", {"Pong": (overrides, "points_won", 3)})
    rows = list(training_benchmarks.learners(CPU, seeds=(1, 2), envs=("Pong",)))
    assert [row["what"] for row in rows] == [
        f"Pong, {title}, 3 s, seed 1{measurement}"
        for title in ("PPO", "R2D2")
        for measurement in (", median rate", ": points_won in first episodes")
    ]
    assert all(0 <= row["value"] <= 1 for row in rows[1::2])
    fields = dict(benchmark="learners", on="NVIDIA H200", date="2026-11-22")
    figures.plot_learners([row | fields for row in rows], tmp_path / "learners.svg")
    figure = (tmp_path / "learners.svg").read_text()
    assert "PPO" in figure and "R2D2" in figure


@pytest.mark.nightly
def test_curricula_are_compared_by_source_and_worst_homes(monkeypatch):
    small = "env=pointgoal", "env.n_envs=32", "env.res=16", "env.subsample=1"
    homes = "geometry=mixed", "geometry.parts={homes:8,mazes:{source:maze,n:4}}", "logging.every=1"
    recipe = *small, *homes, *training_benchmarks.NO_FINISH
    places = "generated:{source:homes,n:4},dense:{source:homes,n:20,density:2}"
    monkeypatch.setattr(training_benchmarks, "CURRICULUM_RECIPE", recipe)
    monkeypatch.setattr(
        training_benchmarks,
        "EVALUATED_IN",
        ("geometry=suite", f"geometry.parts={{{places}}}", "episodes=20", "baseline=false"),
    )
    monkeypatch.setattr(training_benchmarks, "CURRICULA", ("none", "plr"))
    learnability = *training_benchmarks.LEARNABILITY, *small, "geometry.n=4", "env.limit=8"
    monkeypatch.setattr(training_benchmarks, "LEARNABILITY", learnability)
    monkeypatch.setattr(training_benchmarks, "LEARNABILITY_SECONDS", 3)
    *rows, seconds = training_benchmarks.curricula(CPU, seeds=(1, 2), samples=4096)
    # generated, dense, its worst homes and the worst source; success and SPL
    assert len(rows) == 2 * 4 * 2
    assert {row["n"] for row in rows} == {2} and all(0 <= row["value"] <= 1 for row in rows)
    assert rows[0]["what"] == "pointgoal, 0 M samples, curriculum none, generated: success"
    assert any(row["what"].endswith("plr, dense, worst 5 % of homes: spl") for row in rows)
    assert 0 < seconds["value"] <= training_benchmarks.LEARNABILITY_SECONDS
