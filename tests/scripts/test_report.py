"""The page and the figures that are written from the benchmarks' records."""

import json

import benchmark
import figures
import paths
import records
import report


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


def test_report_writes_page_and_plot_reproducibly(tmp_path):
    path = write_records(
        tmp_path,
        record("explorer, `env.step`, 1,024 environments", 12.5, lower=12.0, upper=13.0, n=15),
        record("explorer, `env.step`, 1,024 environments, as trained, in a rollout", 7.5),
        record("minimal, `env.step`, 8,192 environments", 70.0),
    )
    written = []
    for _ in range(2):
        assert benchmark.main(["report", "--json", str(path)]) == 0
        names = "benchmark-table.md", "benchmark-table.svg"
        written.append([(tmp_path / name).read_text() for name in names])
    (page, plot), second = written
    assert [page, plot] == second
    assert "<svg" in plot and "explorer, NVIDIA H200" in plot
    assert "explorer, as trained, NVIDIA H200" in plot
    cells = "12.5 M/s | 12 to 13 | 15 | NVIDIA H200 | abc | 2026-01-01 |"
    assert f"| `step` | explorer, `env.step`, 1,024 environments | {cells}" in page


def test_plot_has_one_point_per_size_of_the_plain_environment(tmp_path):
    """That of a step per graph, though the page has both."""
    rows = [record(f"explorer, `env.step`, {n} environments", 12.5) for n in ("1,024", "4,096")]
    other = record("explorer, `env.step`, 4,096 environments, in a rollout", 99.0)
    plots = []
    for records_of in (rows, [*rows, other]):
        path = write_records(tmp_path, *records_of)
        assert benchmark.main(["report", "--json", str(path)]) == 0
        plots.append((tmp_path / "benchmark-table.svg").read_text())
    assert plots[0] == plots[1]
    assert "in a rollout | 99 M/s" in (tmp_path / "benchmark-table.md").read_text()


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


def test_committed_page_matches_committed_records():
    """If this fails: python scripts/benchmarks/benchmark.py report."""
    page = paths.RECORDS.with_name("benchmark-table.md").read_text()
    assert report.page(records.read(paths.RECORDS), "benchmark-table.svg") == page
    assert paths.RECORDS.with_name("benchmark-table.svg").exists()


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
