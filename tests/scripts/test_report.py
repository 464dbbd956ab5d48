"""The figures that are drawn from the benchmarks' records, and the tables that state them."""

import json
import re

import benchmark
import numpy as np
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


# ---- The two tables of headline figures ----

STEP = "explorer, `env.step`, {} environments"
TRAINED = "training, {} s, seed \\d, return in unseen homes"
#: README's figures: text in the table, form, and the records, whose median, or range, it is.
HEADLINES = [
    ("178.7 M", "{:.1f} M", STEP.format("1,048,576")),
    ("77 M", "{:.0f} M", STEP.format("4,096") + ", as trained, in a rollout"),
    ("22.5 M", "{:.1f} M", "training, 30 s, seed \\d, median rate"),
    ("2.0 M", "{:.1f} M", "Explorer, LSTM-256, pufferlib 3.0.0, float32"),
    ("50 to 54", "{:.0f} to {:.0f}", TRAINED.format(3)),
    ("58.7 to 59.8", "{:.1f} to {:.1f}", TRAINED.format(30)),
]


def tables_of(page):
    return [line.split(" | ") for line in (records.ROOT / page).read_text().splitlines()]


def values_of(what):
    """Returns the newest records on an H200 whose names match a regular expression."""
    rows = records.newest(records.read(records.RECORDS))
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
