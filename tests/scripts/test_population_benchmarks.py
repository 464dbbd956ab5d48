"""Benchmarks of populations: tiny runs of each."""

import population_benchmarks
import pytest
import torch

from tests.helpers import tiny

CPU = torch.device("cpu")


@pytest.fixture
def tiny_populations(monkeypatch):
    def set_all(**values):
        for name, value in values.items():
            monkeypatch.setattr(population_benchmarks, name, value)

    small = ("env.n_envs=16", *tiny.TINY[3:-2], "logging.every=1")
    pair = {"cpu": (2, 16, 16)}
    set_all(MEMBERS=pair, SMALL_MEMBERS=pair, N_MEMBERS={"cpu": 2}, EVERY={"cpu": 128})
    set_all(EPISODES={"cpu": 8}, RATED=("env=explorer", *small), EXPLORER=("env=explorer", *small))
    set_all(MEMORY=("experiment=memory_9", "env.limit=16", *small))
    set_all(DEATHMATCH=("env=deathmatch", "geometry=box", "env.n_agents=2", *small))
    set_all(OPPONENTS=("opponents.snapshots=2", "opponents.every=2"))


def test_interval_of_decided_duels_is_wilsons():
    row = population_benchmarks._decided("x", dict(wins=60, losses=40, draws=9))
    assert row["value"] == 0.6 and row["n"] == 100
    assert row["lower"] == pytest.approx(0.502, abs=1e-3)
    assert row["upper"] == pytest.approx(0.691, abs=1e-3)
    assert population_benchmarks._decided("x", dict(wins=0, losses=0))["n"] == 0


@pytest.mark.nightly
def test_rates_are_sums_over_members(tiny_populations):
    one, several, share = population_benchmarks.members(CPU, seconds=4)
    assert "one run" in one["what"] and "2 members in sum" in several["what"]
    assert share["value"] == pytest.approx(100 * several["value"] / one["value"])


@pytest.mark.nightly
def test_search_and_league_measure_their_best_in_unseen_homes(tiny_populations, tmp_path):
    rows = [*population_benchmarks.memory_search(CPU, seconds=4, folder=tmp_path)]
    assert [row["what"].rpartition(": ")[2] for row in rows] == 2 * [
        "return of the best, in unseen homes",
        "generations",
    ]
    assert rows[1]["value"] > 0 == rows[3]["value"]
    kept = sorted(path.name for path in tmp_path.iterdir())
    assert kept == ["Memory-9x9-PBT-over-2-1", "Memory-9x9-best-of-2-drawn-at-random-1"]
    rows = [*population_benchmarks.league(CPU, seconds=4)]
    assert len(rows) == 6 and all(0 <= row["value"] <= 1 for row in rows)
    assert sum("against the hunter" in row["what"] for row in rows) == 4
