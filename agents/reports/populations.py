"""The part of a report that is about a population: lineage, settings over time, best and median."""

from collections.abc import Callable, Sequence

import numpy as np

from megastep.agents.reports.runs import Run
from megastep.agents.runs import populations

#: A line of the chart of scores, and what it is of the members' scores.
SUMMARIES = {"best": np.nanmax, "median": np.nanmedian}


def section(
    every: Sequence[Run], chart: Callable[..., str], table: Callable[..., str]
) -> list[str]:
    """Returns the HTML about the population whose members the runs are; nothing if they are none.

    Args:
        every: the runs.
        chart: adds a chart of a title, x and lines, and returns its place.
        table: makes a table of a head and rows.
    """
    path = min(run.folder.parent for run in every) / populations.FILE
    if len({run.folder.parent for run in every}) > 1 or not path.is_file():
        return []
    generations = populations.read(path)
    n = len(every)
    generations = [rows for rows in generations if len(rows) == n]
    if n < 2 or not generations:
        return []
    lines = []
    for member in range(n):
        own = [rows[member] for rows in generations]
        copied = [f"{r['generation']} from {r['from']}" for r in own if r["from"] != member]
        line = populations.lineage(generations, member)
        ancestors = [str(n) for i, n in enumerate(line) if i == 0 or n != line[i - 1]]
        n_diverged = str(sum(int(row.get("diverged", 0)) for row in own))
        lines.append([str(member), " → ".join(ancestors), ", ".join(copied) or "never", n_diverged])
    x, shown = [int(rows[0]["samples"]) for rows in generations], {}
    scores = np.array([[row.get("score") for row in rows] for rows in generations], float)
    if not np.isnan(scores).all():
        shown["score of the population"] = {
            name: [np.nan if np.isnan(row).all() else float(of(row)) for row in scores]
            for name, of in SUMMARIES.items()
        }
    for key in populations.settings_of(generations[0][0]):
        shown[key] = {
            f"member {member}": [populations.settings_of(rows[member])[key] for rows in generations]
            for member in range(n)
        }
    places = [chart(title, x, series) for title, series in shown.items()]
    head = ["member", "descends from", "copied at generation", "diverged"]
    return ["<h2>Population</h2>", table(head, lines), f'<div class="grid">{"".join(places)}</div>']
