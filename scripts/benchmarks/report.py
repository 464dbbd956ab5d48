"""Tables of the records of benchmark.py, for a terminal and for the site, and their figures."""

from pathlib import Path

import figures
import records
from catalogue import BENCHMARKS

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


def page(rows: list[dict]) -> str:
    """Returns what each benchmark measures, and a table of the newest of ``rows``."""
    descriptions = [
        f"- `{name}`: {' '.join(benchmark.__doc__.split())}"
        for name, benchmark in BENCHMARKS.items()
    ]
    table = [HEADER, *map(row, records.newest(rows))]
    return "\n".join([*descriptions, "", *table])


def write(path: Path) -> None:
    """Draws the figures next to the records in ``path``."""
    rows = records.read(path)
    figures.plot_frames_per_second(rows, path.with_name("frames.svg"))
    figures.plot_training(rows, path.with_name("results.svg"))
    figures.plot_scaling(rows, path.with_name("scaling.svg"))
