"""The benchmarks: what a measurement is, that every benchmark runs, and that the page says what the
records say.
"""

import inspect
import json
import subprocess
import sys
from pathlib import Path

import benchmark
import benchmark_report
import counters
import pytest
import replays
import timing
import torch
import trainings
import workloads

ROOT = Path(__file__).resolve().parents[2]
KEYS = {
    "benchmark",
    "what",
    "value",
    "unit",
    "lower",
    "upper",
    "n",
    "on",
    "driver",
    "torch",
    "cuda",
    "commit",
    "date",
    "command",
}


@pytest.fixture
def tiny(monkeypatch):
    """Benchmarks of a few environments in two homes, timed for a moment."""
    for name, value in dict(
        SIZES={"cuda": (8,), "cpu": (8,)},
        KERNEL_SIZES={"cuda": (8,), "cpu": (8,)},
        ARENAS={"cuda": (8,), "cpu": (8,)},
        HOMES=2,
        WARM_UP=2,
    ).items():
        monkeypatch.setattr(workloads, name, value)
    for name, value in dict(N_LANES=8, ROLLOUTS=2, SAMPLED=4).items():
        monkeypatch.setattr(replays, name, {"cuda": value, "cpu": value})
    monkeypatch.setattr(timing, "REPEATS", 3)
    monkeypatch.setattr(timing, "SECONDS", 1e-3)


def record(what, value, **others):
    return (
        dict(
            benchmark="step",
            what=what,
            value=value,
            unit="M/s",
            lower=None,
            upper=None,
            n=None,
            on="NVIDIA H200",
            driver=None,
            torch=None,
            cuda=None,
            commit="abc",
            date="2026-01-01",
            command="",
        )
        | others
    )


def written(folder, *records):
    """The path of records in ``folder``."""
    path = folder / "benchmarks.jsonl"
    path.write_text("".join(json.dumps(r) + "\n" for r in records))
    return path


# ---- Measurements ----


def test_a_measurement_is_a_median_with_its_tenth_and_ninetieth_percentile():
    found = timing.measurement("what", "s", [11, 1, 10, 2, 9, 3, 8, 4, 7, 5, 6])
    assert found == dict(what="what", unit="s", value=6, lower=2, upper=10, n=11)


def test_what_was_sampled_once_has_no_spread():
    assert timing.measurement("what", "bytes", [7]) == dict(
        what="what", unit="bytes", value=7, lower=None, upper=None, n=1
    )


def test_a_thousand_things_in_two_milliseconds_are_half_a_million_a_second():
    assert timing.rate("what", 1000, [0.002])["value"] == pytest.approx(0.5)


def test_a_lap_makes_the_calls_it_is_said_to():
    calls = []
    assert (
        len(timing.laps(lambda: calls.append(1), torch.device("cpu"), 4, 3)) == 3
        and len(calls) == 12
    )


def test_learning_curves_are_the_mean_and_range_of_seeds(tmp_path):
    records = [
        record(f"training, 10 s, seed {seed}, return in unseen homes", 40.0 + seed)
        for seed in (1, 2, 3)
    ] + [
        record(
            f"training, 10 s, seed {seed}, median rate",
            7.0,
            curve=[[1, 50, seed], [10, 99, 7 * seed]],
        )
        for seed in (1, 2, 3)
    ]
    (run,) = benchmark_report.learning_curves(records).values()
    assert run["evaluated"] == [41, 42, 43] and run["seconds"][[0, -1]].tolist() == [1, 10]
    ends = [run[key][[0, -1]].tolist() for key in ("mean", "lower", "upper")]
    assert ends == [[2, 14], [1, 7], [3, 21]]
    path = written(tmp_path, *records)
    assert benchmark.main(["report", "--json", str(path)]) == 0
    assert "seeds: 3" in (tmp_path / "results.svg").read_text()


# ---- Benchmarks ----


@pytest.mark.parametrize("name", benchmark.BENCHMARKS)
def test_a_benchmark_is_a_generator_that_says_what_it_measures(name):
    assert (
        inspect.isgeneratorfunction(benchmark.BENCHMARKS[name])
        and benchmark.BENCHMARKS[name].__doc__
    )


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize(
    ("name", "n"),
    [
        *(("step", 3), ("kernels", 8), ("observe", 2), ("deathmatch", 2), ("memory", 1)),
        *(("replay", 9), ("pong", 2)),
    ],
)
def test_a_benchmark_leaves_a_line_of_json_per_measurement(name, n, device, tiny, tmp_path, capsys):
    path = tmp_path / "records.jsonl"
    assert benchmark.main([name, "--device", device, "--commit", "abc", "--json", str(path)]) == 0
    records = benchmark_report.read(path)
    more = {("memory", "cuda"): 1, ("pong", "cpu"): 2}
    assert len(records) == n + more.get((name, device), 0)
    for r in records:
        assert set(r) == KEYS and r["benchmark"] == name and r["commit"] == "abc" and r["value"] > 0
        assert r["lower"] is None or r["lower"] <= r["value"] <= r["upper"]
        assert r["on"].startswith("CPU, ") == (device == "cpu") and (r["driver"] is None) == (
            device == "cpu"
        )
    assert len(capsys.readouterr().out.splitlines()) == 2 + len(records)


def test_the_cpu_is_measured_on_the_cpu_and_keeps_its_threads(tiny):
    threads = torch.get_num_threads()
    records = list(benchmark.measure("cpu", torch.device("cpu"), "abc"))
    assert [r["unit"] for r in records] == [
        "k/s",
        "times",
        "times",
    ] and torch.get_num_threads() == threads
    assert all(r["on"].startswith("CPU, ") for r in records)


@pytest.mark.slow
def test_worlds_are_trained_and_evaluated_where_they_say(monkeypatch):
    recipe = (
        "env=pong preset=cpu samples=8192 env.n_envs=32 log_every=1",
        {"": "", "games": "episodes=7"},
    )
    monkeypatch.setattr(trainings, "RECIPES", {"Pong": recipe})
    records = list(trainings.worlds(torch.device("cpu")))
    rate = records.pop(0)
    assert rate["unit"] == "M/s" and all(0 <= won <= 1 for _, _, won in rate["curve"])
    assert len(records) == 2 * 2 * 2 and {r["n"] for r in records} == {1024, 7}
    assert all(r["what"].startswith("Pong, ") for r in records)
    words = [r["what"].split(", ")[-2:] for r in records]
    assert sum("points_won" in " ".join(w) for w in words) == 4
    assert sum("random" in " ".join(w) for w in words) == 4


@pytest.mark.slow
def test_runs_of_deathmatch_are_trained_side_by_side_and_duel(monkeypatch):
    small = "geometry=box", "env.n_envs=16", "log_every=1", "preset=cpu"
    monkeypatch.setattr(trainings, "DEATHMATCH", (*trainings.DEATHMATCH, *small))
    monkeypatch.setattr(trainings, "ABLATIONS", {"one": "", "other": "env.fov=130"})
    monkeypatch.setattr(trainings, "N_SNAPSHOTS", 2)
    monkeypatch.setattr(trainings, "N_DUELS", 16)
    device = torch.device("cpu")
    records = list(trainings.duels(device, seeds=(1, 2), samples=8192))
    for seed in (1, 2):
        own = [r for r in records if f"seed {seed}" in r["what"]]
        words = " ".join(r["what"] for r in own)
        assert len(own) == 6 and "against Bot (" in words and "rating of Bot" in words
    changed = list(trainings.ablation(device, samples=2048))
    assert len(changed) == 4 and all(0 <= r["value"] <= 1 for r in changed)


def test_a_curve_joins_what_was_earned_to_when(tmp_path):
    (tmp_path / "metrics.jsonl").write_text(
        '{"samples": 10, "lr": 1}\n{"samples": 20, "episode/return": 3.5}\n'
    )
    (tmp_path / "perf.jsonl").write_text(
        '{"samples": 10, "perf/seconds": 1.0}\n{"samples": 20, "perf/seconds": 2.0}\n'
    )
    assert trainings.curve(tmp_path) == [(2.0, 20, 3.5)]


def test_an_unknown_benchmark_ends_with_one_sentence():
    done = subprocess.run(
        [sys.executable, "scripts/benchmarks/benchmark.py", "stpe"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.count("\n") == 1 and "'stpe'; did you mean 'step'?" in done.stderr


def counted(*names):
    header = ["ID", "Kernel Name", *counters.METRICS]
    values = [f"{65_536 * (k + 1):,}" for k in range(len(counters.METRICS))]
    rows = [[str(i), name, *values] for i, name in enumerate(names)]
    units = ["", "", *len(counters.METRICS) * ["unit"]]
    return "a word before\n" + "\n".join(
        ",".join(f'"{cell}"' for cell in line) for line in [header, units, *rows]
    )


def test_counters_are_read_kernel_by_kernel():
    names = [name for name, _ in counters.KERNELS]
    found = list(counters.measurements(counted(*names[:3], "void at::add<int>", *names[3:])))
    assert len(found) == len(counters.KERNELS) * len(counters.METRICS)
    assert [f["value"] for f in found[:3]] == [1.0, 2.0, 3 * 65_536.0]
    assert found[1]["what"] == "`physics`: warp instructions"
    with pytest.raises(ValueError, match="did not count"):
        list(counters.measurements(counted(*names[:-1])))


def test_counters_without_a_gpu_end_with_one_sentence(capsys):
    assert benchmark.main(["counters", "--device", "cpu"]) == 2
    assert "counters needs a GPU" in capsys.readouterr().err


# ---- The report ----


def test_a_report_is_a_page_with_a_plot_and_the_same_again(tmp_path):
    path = written(
        tmp_path,
        record("explorer, `env.step`, 1,024 environments", 12.5, lower=12.0, upper=13.0, n=15),
        record("minimal, `env.step`, 8,192 environments", 70.0),
    )
    files = []
    for _ in range(2):
        assert benchmark.main(["report", "--json", str(path)]) == 0
        files.append([(tmp_path / f"benchmark-table.{end}").read_text() for end in ("md", "svg")])
    (page, plot), again = files
    assert [page, plot] == again and "<svg" in plot and "explorer, NVIDIA H200" in plot
    cells = "12.5 M/s | 12 to 13 | 15 | NVIDIA H200 | abc | 2026-01-01 |"
    assert f"| `step` | explorer, `env.step`, 1,024 environments | {cells}" in page


def test_the_newest_record_of_a_measurement_is_shown_and_sizes_are_in_order():
    records = [
        record("a, 8,192 environments", 2.0, date="2026-01-03"),
        record("a, 8,192 environments", 1.0),
        record("a, 1,024 environments", 3.0),
        record("a, 1,024 environments", 4.0),
        record("a, 1,024 environments", 5.0, on="CPU, 2 threads"),
        record("a, 1,024 environments", 6.0, on="CPU, 16 threads"),
    ]
    assert [r["value"] for r in benchmark_report.newest(records)] == [4.0, 2.0, 6.0]


def test_records_that_differ_in_counts_are_of_one_measurement():
    records = [
        record("duels (3 won, 0 drawn, 1 lost)", 1.0),
        record("rating of 120,198,592 samples", 2.0),
        record("rating of 240,198,592 samples", 3.0),
        record("duels (2 won, 1 drawn, 1 lost)", 4.0),
        record("rating of 120,223,040 samples", 5.0),
    ]
    assert [r["value"] for r in benchmark_report.newest(records)] == [4.0, 5.0, 3.0]


def test_the_page_says_what_the_records_say():
    """If this fails: python scripts/benchmarks/benchmark.py report."""
    records = benchmark_report.read(ROOT / "docs" / "lab" / "benchmarks.jsonl")
    page = (ROOT / "docs" / "lab" / "benchmark-table.md").read_text()
    assert benchmark_report.page(records, "benchmark-table.svg") == page
    assert (ROOT / "docs" / "lab" / "benchmark-table.svg").exists()


def test_a_record_says_the_command_that_measures_it_again(monkeypatch):
    def duels(device, seeds=(1, 2, 3), samples=10):
        yield dict(what="a", value=1.0, unit="", lower=None, upper=None, n=None)

    monkeypatch.setitem(benchmark.BENCHMARKS, "duels", duels)
    (found,) = benchmark.measure("duels", torch.device("cpu"), "abc", dict(seeds=[3, 4], samples=5))
    told = "python scripts/benchmarks/benchmark.py duels --seeds 3 4 --samples 5 --device cpu"
    assert found["command"] == told


@pytest.mark.slow
def test_learners_are_compared_and_drawn(monkeypatch, tmp_path):
    two = {name: trainings.LEARNERS[name] for name in ("PPO", "R2D2")}
    ahead = {trainings.AHEAD: trainings.LEARNERS[trainings.AHEAD]}  # in Explorer alone
    monkeypatch.setattr(trainings, "LEARNERS", two | ahead)
    how = "env=pong agent.core=none preset=cpu env.n_envs=64 log_every=2", "points_won", 3
    monkeypatch.setattr(trainings, "COMPARED", {"Pong": how})
    found = list(trainings.learners(torch.device("cpu"), (1, 2), worlds=("Pong",)))
    assert [r["what"] for r in found] == [
        f"Pong, {name}, 3 s, seed 1{told}"
        for name in two
        for told in (", median rate", ": points_won in first episodes")
    ]
    assert all(0 <= r["value"] <= 1 for r in found[1::2])
    more = dict(benchmark="learners", on="NVIDIA H200", date="2026-11-22")
    records = [{**r, **more} for r in found]
    benchmark_report.plot_learners(records, tmp_path / "learners.svg")
    drawn = (tmp_path / "learners.svg").read_text()
    assert all(name in drawn for name in two)
