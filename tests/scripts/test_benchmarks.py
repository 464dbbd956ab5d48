"""The benchmarks: timing, measurements, records, and a tiny run of each on both devices."""

import benchmark
import engine_operations
import env_steps
import learning
import pytest
import random_walks
import records
import timing
import torch

RECORD_KEYS = {
    *("benchmark", "what", "value", "unit", "lower", "upper", "n"),
    *("on", "driver", "torch", "cuda", "commit", "date", "command"),
}


@pytest.fixture
def tiny_benchmarks(monkeypatch):
    """Shrinks the benchmarks to a few environments in two homes, timed for milliseconds."""
    for module, name, value in (
        (env_steps, "N_ENVS", (8,)),
        (env_steps, "N_ENVS_IN_ROLLOUTS", (8,)),
        (env_steps, "N_ARENAS", (8,)),
        (engine_operations, "N_AGENTS", (8,)),
        (engine_operations, "N_ARENAS", 8),
        (learning, "N_GRIDS", (8,)),
        (learning, "RUNS", (learning.Run("free", 8, 2, "minGRU", dict(core="mingru"), 4),)),
    ):
        monkeypatch.setattr(module, name, {"cuda": value, "cpu": value})
    monkeypatch.setattr(random_walks, "N_HOMES", 2)
    monkeypatch.setattr(random_walks, "N_WARM_UP", 2)
    monkeypatch.setattr(timing, "N_SAMPLES", 3)
    monkeypatch.setattr(timing, "SAMPLE_SECONDS", 1e-3)


# ---- Benchmarks ----


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize(
    ("name", "n_records"),
    [
        *(("step", 5), ("kernels", 8), ("observe", 2), ("agents", 1), ("deathmatch", 2)),
        *(("memory", 1), ("pong", 2), ("grids", 7), ("ppo", 1)),
    ],
)
def test_benchmark_appends_json_lines(name, n_records, device, tiny_benchmarks, tmp_path, capsys):
    path = tmp_path / "records.jsonl"
    assert benchmark.main([name, "--device", device, "--commit", "abc", "--json", str(path)]) == 0
    rows = records.read(path)
    n_more = {("memory", "cuda"): 1, ("pong", "cpu"): 2}
    assert len(rows) == n_records + n_more.get((name, device), 0)
    for row in rows:
        assert set(row) == RECORD_KEYS and row["value"] > 0
        assert row["benchmark"] == name and row["commit"] == "abc"
        assert row["lower"] is None or row["lower"] <= row["value"] <= row["upper"]
        assert row["on"].startswith("CPU, ") == (device == "cpu")
        assert (row["driver"] is None) == (device == "cpu")
    assert len(capsys.readouterr().out.splitlines()) == 2 + len(rows)


def test_cpu_benchmark_restores_number_of_threads(tiny_benchmarks):
    n_threads = torch.get_num_threads()
    rows = list(benchmark.measure("cpu", torch.device("cpu"), "abc"))
    assert [row["unit"] for row in rows] == ["k/s", "times", "times"]
    assert all(row["on"].startswith("CPU, ") for row in rows)
    assert torch.get_num_threads() == n_threads
