"""The part of a report that is about a population: lineage, settings over time, best and median."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from megastep.agents.reports.runs import Run
from megastep.agents.runs import populations

if TYPE_CHECKING:
    from megastep.agents.types import Row

#: A column of the chart of scores, and what it is of the members' scores.
SUMMARIES = {"best": np.nanmax, "median": np.nanmedian}


def section(every: Sequence[Run], charts: "list[Row]", table: Callable[..., str]) -> list[str]:
    """Returns the HTML about the population whose members the runs are; nothing if they are none.

    Args:
        every: the runs.
        charts: what charts show; those of the population are appended.
        table: makes a table of a head and rows.
    """
    roots = {run.folder.parent for run in every}
    path = min(roots) / populations.FILE
    if len(roots) > 1 or len(every) < 2 or not path.is_file():
        return []
    generations = populations.read(path)
    n = len(generations[0]) if generations else 0
    generations = [rows for rows in generations if len(rows) == n]
    if not generations or n != len(every):
        return []
    return [
        "<h2>Population</h2>",
        table(["member", "descends from", "copied at generation", "diverged"], _rows(generations)),
        f'<div class="grid">{"".join(_places(generations, charts))}</div>',
    ]


def _rows(generations) -> list[list[str]]:
    rows = []
    for member in range(len(generations[0])):
        copied = [
            f"{row['generation']} from {row['from']}"
            for row in (rows[member] for rows in generations)
            if row["from"] != member
        ]
        n_diverged = sum(int(rows[member].get("diverged", 0)) for rows in generations)
        line = populations.lineage(generations, member)
        ancestors = [str(n) for i, n in enumerate(line) if i == 0 or n != line[i - 1]]
        rows.append(
            [str(member), " → ".join(ancestors), ", ".join(copied) or "never", str(n_diverged)]
        )
    return rows


def _places(generations, charts) -> list[str]:
    """Returns the places of the charts: best and median score, then each setting by member."""
    samples = [int(rows[0]["samples"]) for rows in generations]
    scores = np.array([[_number(row.get("score")) for row in rows] for rows in generations])
    lines: dict[str, dict[str, list]] = {}
    if not np.isnan(scores).all():
        lines["score of the population"] = {
            name: [None if np.isnan(row).all() else float(of(row)) for row in scores]
            for name, of in SUMMARIES.items()
        }
    for key in populations.settings_of(generations[0][0]):
        lines[key] = {
            f"member {member}": [populations.settings_of(rows[member])[key] for rows in generations]
            for member in range(len(generations[0]))
        }
    places = []
    for title, series in lines.items():
        chart = dict(id=f"chart-{len(charts)}", title=title, x_label="samples", sync="samples")
        shown = [
            dict(label=label, colour=i, is_bound=False, y=y)
            for i, (label, y) in enumerate(series.items())
        ]
        charts.append(chart | dict(x=samples, series=shown, bands=[]))
        places.append(f'<div class="chart" id="{chart["id"]}"></div>')
    return places


def _number(value: float | None) -> float:
    return float("nan") if value is None else value
