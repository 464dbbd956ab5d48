"""The benchmark: what a figure is, that every work is measurable, and that the page says what the
records say.
"""

import inspect
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from scripts import benchmark, counters

ROOT = Path(__file__).resolve().parents[1]
KEYS = {
    "work",
    "what",
    "value",
    "unit",
    "low",
    "high",
    "n",
    "on",
    "driver",
    "torch",
    "cuda",
    "commit",
    "date",
    "command",
}
PAGE = "\n\n".join(["# Title", "Before.", *benchmark.MARKS, "After.\n"])


@pytest.fixture
def tiny(monkeypatch):
    """Works of a few environments in two homes, timed for a moment."""
    for name, value in dict(
        SIZES={"cuda": (8,), "cpu": (8,)},
        KERNEL_SIZES={"cuda": (8,), "cpu": (8,)},
        HOMES=2,
        WARM_UP=2,
        REPEATS=3,
        SECONDS=1e-3,
    ).items():
        monkeypatch.setattr(benchmark, name, value)


def record(what, value, **others):
    return (
        dict(
            work="step",
            what=what,
            value=value,
            unit="M/s",
            low=None,
            high=None,
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


def kept(folder, *records):
    """A page and its records in ``folder``; the path of the records."""
    path = folder / "benchmarks.jsonl"
    path.write_text("".join(json.dumps(r) + "\n" for r in records))
    path.with_suffix(".md").write_text(PAGE)
    return path


# ---- Figures ----


def test_a_figure_is_a_median_with_its_tenth_and_ninetieth_percentile():
    found = benchmark.figure("what", "s", [11, 1, 10, 2, 9, 3, 8, 4, 7, 5, 6])
    assert found == dict(what="what", unit="s", value=6, low=2, high=10, n=11)


def test_what_was_sampled_once_has_no_spread():
    assert benchmark.figure("what", "bytes", [7]) == dict(
        what="what", unit="bytes", value=7, low=None, high=None, n=1
    )


def test_a_thousand_things_in_two_milliseconds_are_half_a_million_a_second():
    assert benchmark.rate("what", 1000, [0.002])["value"] == pytest.approx(0.5)


def test_a_lap_makes_the_calls_it_is_said_to():
    calls = []
    assert (
        len(benchmark.laps(lambda: calls.append(1), torch.device("cpu"), 4, 3)) == 3
        and len(calls) == 12
    )


# ---- Works ----


@pytest.mark.parametrize("name", benchmark.WORKS)
def test_a_work_is_a_generator_that_says_what_it_measures(name):
    assert inspect.isgeneratorfunction(benchmark.WORKS[name]) and benchmark.WORKS[name].__doc__


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize(
    ("name", "n"), [("step", 2), ("kernels", 7), ("observe", 2), ("memory", 1)]
)
def test_a_work_leaves_a_line_of_json_a_figure(name, n, device, tiny, tmp_path, capsys):
    path = tmp_path / "records.jsonl"
    assert benchmark.main([name, "--device", device, "--commit", "abc", "--json", str(path)]) == 0
    records = benchmark.read(path)
    assert len(records) == n + (name == "memory" and device == "cuda")
    for r in records:
        assert set(r) == KEYS and r["work"] == name and r["commit"] == "abc" and r["value"] > 0
        assert r["low"] is None or r["low"] <= r["value"] <= r["high"]
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


def test_a_work_that_is_not_there_ends_with_one_sentence():
    done = subprocess.run(
        [sys.executable, "scripts/benchmark.py", "stpe"], cwd=ROOT, capture_output=True, text=True
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
    found = list(counters.figures(counted(*names[:3], "void at::add<int>", *names[3:])))
    assert len(found) == len(counters.KERNELS) * len(counters.METRICS)
    assert [f["value"] for f in found[:3]] == [1.0, 2.0, 3 * 65_536.0]
    assert found[1]["what"] == "`physics`: warp instructions"
    with pytest.raises(ValueError, match="did not count"):
        list(counters.figures(counted(*names[:-1])))


def test_counters_without_a_gpu_end_with_one_sentence(capsys):
    assert benchmark.main(["counters", "--device", "cpu"]) == 2
    assert "counters needs a GPU" in capsys.readouterr().err


# ---- The report ----


def test_a_report_stands_between_its_marks_and_is_the_same_again(tmp_path):
    path = kept(
        tmp_path,
        record("explorer, `env.step`, 1,024 environments", 12.5, low=12.0, high=13.0, n=15),
        record("minimal, `env.step`, 8,192 environments", 70.0),
    )
    files = []
    for _ in range(2):
        assert benchmark.main(["report", "--json", str(path)]) == 0
        files.append([path.with_suffix(suffix).read_text() for suffix in (".md", ".svg")])
    (page, plot), again = files
    assert [page, plot] == again and "<svg" in plot and "explorer, NVIDIA H200" in plot
    assert page.startswith("# Title\n\nBefore.\n") and page.endswith("\n\nAfter.\n")
    assert (
        "| `step` | explorer, `env.step`, 1,024 environments | 12.5 M/s | 12 to 13 | 15 | NVIDIA "
        "H200 | abc | "
        "2026-01-01 |"
    ) in page


def test_the_newest_record_of_a_figure_is_kept_and_sizes_are_in_order():
    records = [
        record("a, 8,192 environments", 2.0, date="2026-01-03"),
        record("a, 8,192 environments", 1.0),
        record("a, 1,024 environments", 3.0),
        record("a, 1,024 environments", 4.0),
        record("a, 1,024 environments", 5.0, on="CPU, 2 threads"),
        record("a, 1,024 environments", 6.0, on="CPU, 16 threads"),
    ]
    assert [r["value"] for r in benchmark.newest(records)] == [4.0, 2.0, 6.0]


def test_a_page_without_marks_is_left_as_it_is(tmp_path, capsys):
    path = kept(tmp_path, record("explorer, `env.step`, 8 environments", 1.0))
    path.with_suffix(".md").write_text("# Title\n")
    assert benchmark.main(["report", "--json", str(path)]) == 2
    assert (
        path.with_suffix(".md").read_text() == "# Title\n"
        and benchmark.MARKS[0] in capsys.readouterr().err
    )


def test_the_page_says_what_the_records_say():
    """If this fails: python scripts/benchmark.py report."""
    page = (ROOT / "docs" / "benchmarks.md").read_text()
    assert (
        benchmark.rewritten(
            page, benchmark.read(ROOT / "docs" / "benchmarks.jsonl"), "benchmarks.svg"
        )
        == page
    )
    assert (ROOT / "docs" / "benchmarks.svg").exists()
