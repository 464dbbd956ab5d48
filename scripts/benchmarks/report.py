"""Writes docs/lab/benchmark-table.md and its figures from the records of benchmark.py."""

import textwrap
from pathlib import Path

import figures
import records
from catalogue import BENCHMARKS

PAGE = """# Benchmark table

Written by `python scripts/benchmarks/benchmark.py report` from `benchmarks.jsonl`. To measure:
`python scripts/benchmarks/benchmark.py BENCHMARK --json docs/lab/benchmarks.jsonl`, with
`--device cpu` for the CPU. [Benchmarks](benchmarks.md) explains the measurements.

![Frames per second over the number of environments, both logarithmic]({plot})

A measurement is the median of n samples, with their 10th and 90th percentiles. A sample is the mean
over as many calls as fill 50 ms, after a warm-up, timed by CUDA events on a GPU. For benchmarks
that start processes or train, a sample is one process, or one logged update of a training run. A
return or a share is a mean with its 95 % bootstrap interval over n homes, or over n episodes if
there are no homes. A rating has an interval of two standard deviations to either side. A
measurement without an interval was counted, or read once with Nsight Compute.

{benchmarks}

{table}
"""
HEADER = (
    "| benchmark | what | median | 10 % to 90 % | n | on | commit | date |\n" + 8 * "| --- " + "|"
)


def formatted(number: float) -> str:
    return f"{number:,.0f}" if abs(number) >= 1000 else f"{number:.4g}"


def row(record: dict) -> str:
    """Returns a record as a row of the Markdown table."""
    lower, upper = record["lower"], record["upper"]
    versions = [(name, record[name]) for name in ("driver", "torch") if record[name]]
    cells = (
        f"`{record['benchmark']}`",
        record["what"],
        f"{formatted(record['value'])} {record['unit']}".strip(),
        "" if lower is None else f"{formatted(lower)} to {formatted(upper)}",
        record["n"] or "",
        ", ".join([record["on"], *(f"{name} {version}" for name, version in versions)]),
        record["commit"],
        record["date"],
    )
    return "| " + " | ".join(map(str, cells)) + " |"


def page(rows: list[dict], plot: str) -> str:
    """Returns the page with the newest of ``rows``; ``plot`` is the file name of its figure."""
    descriptions = [
        textwrap.fill(
            f"- `{name}`: {' '.join(benchmark.__doc__.split())}", 100, subsequent_indent="  "
        )
        for name, benchmark in BENCHMARKS.items()
    ]
    table = "\n".join([HEADER, *map(row, records.newest(rows))])
    return PAGE.format(plot=plot, benchmarks="\n".join(descriptions), table=table)


def write(path: Path) -> None:
    """Writes the page and its figures next to the records in ``path``."""
    rows = records.read(path)
    plot = path.with_name("benchmark-table.svg")
    path.with_name("benchmark-table.md").write_text(page(rows, plot.name))
    figures.plot_frames_per_second(rows, plot)
    figures.plot_training(rows, path.with_name("results.svg"))
    figures.plot_recipes(rows, path.with_name("worlds.svg"))
    figures.plot_ratings(rows, path.with_name("ratings.svg"))
    figures.plot_scaling(rows, path.with_name("scaling.svg"))
    figures.plot_learners(rows, path.with_name("learners.svg"))
    figures.plot_published(rows, path.with_name("published.svg"))
    if (curves := path.with_name("memory.jsonl")).exists():
        figures.plot_memory(records.read(curves), path.with_name("memory.svg"))
