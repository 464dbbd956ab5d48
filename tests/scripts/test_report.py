"""The figures that are drawn from the benchmarks' records, and the tables that state them."""

import json
import re

import benchmark
import figures
import numpy as np
import paths
import pytest
import records


def record(what, value, **fields):
    return (
        dict(benchmark="step", what=what, value=value, unit="M/s", lower=None, upper=None, n=None)
        | dict(on="NVIDIA H200", driver=None, torch=None, cuda=None)
        | dict(commit="abc", date="2026-01-01", command="")
        | fields
    )


def write_records(folder, *rows):
    path = folder / "benchmarks.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def test_report_draws_the_same_figure_again(tmp_path):
    path = write_records(
        tmp_path,
        record("explorer, `env.step`, 1,024 environments", 12.5, lower=12.0, upper=13.0, n=15),
        record("explorer, `env.step`, 1,024 environments, as trained, in a rollout", 7.5),
    )
    plots = []
    for _ in range(2):
        assert benchmark.main(["report", "--json", str(path)]) == 0
        plots.append((tmp_path / "frames.svg").read_text())
    assert plots[0] == plots[1]
    assert "explorer, as trained, NVIDIA H200" in plots[0]


def test_plot_has_one_point_per_size_of_the_plain_environment(tmp_path):
    """That of a step per graph, though there are records of both."""
    rows = [record(f"explorer, `env.step`, {n} environments", 12.5) for n in ("1,024", "4,096")]
    other = record("explorer, `env.step`, 4,096 environments, in a rollout", 99.0)
    plots = []
    for rows_of in (rows, [*rows, other]):
        figures.plot_frames_per_second(rows_of, tmp_path / "frames.svg")
        plots.append((tmp_path / "frames.svg").read_text())
    assert plots[0] == plots[1]


def test_newest_record_per_machine_in_order_of_size():
    rows = [
        record("a, 8,192 environments", 2.0, date="2026-01-03"),
        record("a, 8,192 environments", 1.0),
        record("a, 1,024 environments", 3.0),
        record("a, 1,024 environments", 4.0),
        record("a, 1,024 environments", 5.0, on="CPU, 2 threads"),
        record("a, 1,024 environments", 6.0, on="CPU, 16 threads"),
    ]
    assert [row["value"] for row in records.newest(rows)] == [4.0, 2.0, 6.0]


def test_names_that_differ_in_counts_are_one_measurement():
    rows = [
        record("duels (3 won, 0 drawn, 1 lost)", 1.0),
        record("rating of 120,198,592 samples", 2.0),
        record("rating of 240,198,592 samples", 3.0),
        record("duels (2 won, 1 drawn, 1 lost)", 4.0),
        record("rating of 120,223,040 samples", 5.0),
    ]
    assert [row["value"] for row in records.newest(rows)] == [4.0, 5.0, 3.0]


# ---- The two tables of headline figures ----

STEP = "explorer, `env.step`, {} environments"
TRAINED = "training, {} s, seed \\d, return in unseen homes"
#: README's figures: text in the table, form, and the records, whose median, or range, it is.
HEADLINES = [
    ("178.6 M", "{:.1f} M", STEP.format("1,048,576")),
    ("72 M", "{:.0f} M", STEP.format("4,096") + ", as trained, in a rollout"),
    ("19.2 M", "{:.1f} M", "training, 30 s, seed \\d, median rate"),
    ("2.0 M", "{:.1f} M", "Explorer, LSTM-256, pufferlib 3.0.0, float32"),
    ("52 to 55", "{:.0f} to {:.0f}", TRAINED.format(6)),
    ("59.4 to 59.8", "{:.1f} to {:.1f}", TRAINED.format(30)),
]


def tables_of(page):
    return [line.split(" | ") for line in (paths.ROOT / page).read_text().splitlines()]


def values_of(what):
    """Returns the newest records on an H200 whose names match a regular expression."""
    rows = records.newest(records.read(paths.RECORDS))
    found = [r for r in rows if re.fullmatch(what, r["what"]) and r["on"] == "NVIDIA H200"]
    return sorted(r["value"] for r in found)


@pytest.mark.parametrize("text, form, what", HEADLINES)
def test_readme_states_what_the_records_say(text, form, what):
    values = values_of(what)
    is_range = form.count("{") == 2
    stated = form.format(*values[:: len(values) - 1] if is_range else [np.median(values)])
    assert stated == text
    assert any(text in cell for row in tables_of("README.md")[2:] for cell in row)


def test_benchmarks_states_what_the_records_say():
    rows = [row for row in tables_of("docs/lab/benchmarks.md") if row[0][:3] in ("| 1", "| 4")]
    ends = "", ", in a rollout", ", as trained, in a rollout"
    checked = 0
    for n, *cells in rows:
        for cell, end in zip(cells, ends):
            if (number := cell.strip(" |").split(" M")[0]) and values_of(STEP.format(n[2:]) + end):
                (value,) = values_of(STEP.format(n[2:]) + end)
                assert f"{value:.1f}" == number, (n, end)
                checked += 1
    assert checked


def test_learning_curves_are_mean_and_range_of_seeds(tmp_path):
    what = "training, 10 s, seed"
    rows = [record("training, 60 s, seed 1, median rate", 3.0, curve=[[1, 2, 3]], commit="older")]
    rows += [record(f"{what} {seed}, return in unseen homes", 40.0 + seed) for seed in (1, 2, 3)]
    rows += [
        record(f"{what} {seed}, median rate", 7.0, curve=[[1, 50, seed], end])
        for seed, end in ((seed, [10, 99, 7 * seed]) for seed in (1, 2, 3))
    ]
    rows = [row | dict(benchmark="train") for row in rows]
    (run,) = figures.learning_curves(rows).values()
    assert run["evaluated"] == [41, 42, 43] and run["seconds"][[0, -1]].tolist() == [1, 10]
    ends = [run[key][[0, -1]].tolist() for key in ("mean", "lower", "upper")]
    assert ends == [[2, 14], [1, 7], [3, 21]]
    assert benchmark.main(["report", "--json", str(write_records(tmp_path, *rows))]) == 0
    assert "3 seeds" in (tmp_path / "results.svg").read_text()


def test_scaling_is_plotted_for_the_machine_and_commit_measured_last(tmp_path):
    older = [
        record(f"pong, training on {n}", 1.0, on="A", commit="xyz", benchmark="scaling")
        for n in ("1 GPU", "2 GPUs")
    ]
    rows = [
        record(f"explorer, training on {n} GPU{'s' * (n > 1)}", rate, on=on, benchmark="scaling")
        for on, rates in (("Z", [100.0, 150.0]), ("A", [10.0, 20.0]))
        for n, rate in enumerate(rates, 1)
    ]
    figures.plot_scaling(older + rows, tmp_path / "both.svg")
    figures.plot_scaling(rows[2:], tmp_path / "last.svg")
    assert (tmp_path / "both.svg").read_text() == (tmp_path / "last.svg").read_text()
