"""The benchmarks: timing, measurements, records, and a tiny run of each on both devices."""

import inspect
import json
import subprocess
import sys

import benchmark
import catalogue
import engine_operations
import env_steps
import nsight_counters
import paths
import pytest
import random_walks
import records
import startup_times
import timing
import torch

from megastep import arrdict

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
    ):
        monkeypatch.setattr(module, name, {"cuda": value, "cpu": value})
    monkeypatch.setattr(random_walks, "N_HOMES", 2)
    monkeypatch.setattr(random_walks, "N_WARM_UP", 2)
    monkeypatch.setattr(timing, "N_SAMPLES", 3)
    monkeypatch.setattr(timing, "SAMPLE_SECONDS", 1e-3)


# ---- Timing and measurements ----


def test_measurement_is_median_with_percentiles():
    result = timing.measurement("what", "s", [11, 1, 10, 2, 9, 3, 8, 4, 7, 5, 6])
    assert result == dict(what="what", unit="s", value=6, lower=2, upper=10, n=11)


def test_single_sample_has_no_percentiles():
    result = timing.measurement("what", "bytes", [7])
    assert result == dict(what="what", unit="bytes", value=7, lower=None, upper=None, n=1)


def test_rate_of_thousand_in_two_milliseconds_is_half_a_million_per_second():
    assert timing.rate("what", 1000, [0.002])["value"] == pytest.approx(0.5)


def test_lap_seconds_counts_calls():
    calls = []
    laps = timing.lap_seconds(lambda: calls.append(1), torch.device("cpu"), n_calls=4, n_laps=3)
    assert len(laps) == 3 and len(calls) == 12


# ---- Benchmarks ----


@pytest.mark.parametrize("name", catalogue.BENCHMARKS)
def test_benchmark_is_documented_generator(name):
    assert inspect.isgeneratorfunction(catalogue.BENCHMARKS[name])
    assert catalogue.BENCHMARKS[name].__doc__


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize(
    ("name", "n_records"),
    [
        *(("step", 5), ("kernels", 8), ("observe", 2), ("agents", 1), ("deathmatch", 2)),
        *(("memory", 1), ("pong", 2)),
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


def test_benchmarks_start_without_what_only_importing_floor_plans_needs():
    code = "import sys; sys.modules.update(shapely=None, svgelements=None); import catalogue"
    folder = paths.ROOT / "scripts" / "benchmarks"
    subprocess.run([sys.executable, "-c", code], cwd=folder, check=True)


def test_step_benchmark_measures_explorer_as_trained(tiny_benchmarks, monkeypatch):
    walks = []

    def recorded(walk):
        def recorded_walk(*arguments, **settings):
            env, take_step = walk(*arguments, **settings)
            walks.append((env, settings))
            return env, take_step

        return recorded_walk

    for name in ("walk_in_homes", "walk_in_rollouts"):
        monkeypatch.setattr(env_steps, name, recorded(getattr(random_walks, name)))
    names = [row["what"] for row in env_steps.step(torch.device("cpu"))]
    assert names[0] == "explorer, `env.step`, 8 environments"
    assert names[-1] == "explorer, `env.step`, 8 environments, as trained, in a rollout"
    plain, trained = dict(metrics=False), dict(resample=True, privileged=True, metrics=True)
    assert [settings for _, settings in walks] == [plain, {}, {}, plain, trained]
    decision = arrdict.arrdict(actions=torch.zeros((8, 1), dtype=torch.long))
    plain, as_trained = (env.step(decision) for env, _ in (walks[0], walks[-1]))
    assert {*as_trained} - {*plain} == {"privileged", "metrics"}


@pytest.mark.parametrize(
    ("name", "n_records"),
    [
        pytest.param("startup", 1, marks=pytest.mark.nightly),
    ],
)
def test_startup_benchmark_measures_new_processes(name, n_records, monkeypatch):
    monkeypatch.setattr(startup_times, "N_PROCESSES", 1)
    rows = list(benchmark.measure(name, torch.device("cpu"), "abc"))
    assert len(rows) == n_records
    assert all(0 < row["value"] < 600 and row["unit"] == "s" for row in rows)


def test_cpu_benchmark_restores_number_of_threads(tiny_benchmarks):
    n_threads = torch.get_num_threads()
    rows = list(benchmark.measure("cpu", torch.device("cpu"), "abc"))
    assert [row["unit"] for row in rows] == ["k/s", "times", "times"]
    assert all(row["on"].startswith("CPU, ") for row in rows)
    assert torch.get_num_threads() == n_threads


def test_record_contains_command_that_repeats_it(monkeypatch):
    def trained(device, seeds=(1, 2, 3), budgets=(6,)):
        yield dict(what="a", value=1.0, unit="", lower=None, upper=None, n=None)

    monkeypatch.setitem(catalogue.BENCHMARKS, "train", trained)
    options = dict(seeds=[3, 4], budgets=[5])
    (row,) = benchmark.measure("train", torch.device("cpu"), "abc", options)
    command = "python scripts/benchmarks/benchmark.py train --seeds 3 4 --budgets 5 --device cpu"
    assert row["command"] == command


def test_options_reach_benchmark(monkeypatch, capsys):
    def scaled(device, seeds=(1, 2, 3), envs=("Explorer",)):
        what = json.dumps([list(seeds), list(envs)])
        yield dict(what=what, value=1.0, unit="", lower=None, upper=None, n=None)

    monkeypatch.setitem(catalogue.BENCHMARKS, "scaling", scaled)
    arguments = ["scaling", "--seeds", "2", "--envs", "Pong", "--budgets", "5", "--device", "cpu"]
    assert benchmark.main(arguments) == 0
    assert '[[2], ["Pong"]]' in capsys.readouterr().out


def test_unknown_benchmark_names_closest():
    command = [sys.executable, "scripts/benchmarks/benchmark.py", "stpe"]
    completed = subprocess.run(command, cwd=paths.ROOT, capture_output=True, text=True)
    assert completed.returncode == 2 and not completed.stdout
    assert completed.stderr.count("\n") == 1
    assert "'stpe'" in completed.stderr and "'step'" in completed.stderr


# ---- Nsight Compute ----


def ncu_output(*kernels):
    """Returns CSV as ncu prints it: metric k of every kernel is 65,536 (k + 1)."""
    metrics = nsight_counters.METRICS
    header = ["ID", "Kernel Name", *metrics]
    units = ["", "", *len(metrics) * ["unit"]]
    values = [f"{65_536 * (k + 1):,}" for k in range(len(metrics))]
    rows = [[str(i), kernel, *values] for i, kernel in enumerate(kernels)]
    lines = [",".join(f'"{cell}"' for cell in row) for row in [header, units, *rows]]
    return "\n".join(["==PROF== Connected", *lines])


def test_counters_are_parsed_per_kernel():
    kernels = [kernel for kernel, _ in nsight_counters.KERNELS]
    output = ncu_output(*kernels[:3], "void at::add<int>", *kernels[3:])
    rows = list(nsight_counters.measurements(output))
    assert len(rows) == len(nsight_counters.KERNELS) * len(nsight_counters.METRICS)
    assert [row["value"] for row in rows[:3]] == [1.0, 2.0, 3 * 65_536.0]
    assert rows[1]["what"] == "`physics`: warp instructions"


def test_counters_of_other_kernels_raise():
    kernels = [kernel for kernel, _ in nsight_counters.KERNELS]
    with pytest.raises(ValueError, match="expected kernels"):
        list(nsight_counters.measurements(ncu_output(*kernels[:-1])))


def test_counters_need_gpu(capsys):
    assert benchmark.main(["counters", "--device", "cpu"]) == 2
    assert "GPU" in capsys.readouterr().err
