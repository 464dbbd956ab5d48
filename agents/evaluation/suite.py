"""A suite: geometries of several sources, which are evaluated one by one."""

from megastep.agents.evaluation import statistics
from megastep.agents.factory import components, settings

#: The source of a suite of which the worst homes have a row of their own.
DENSE = "dense"


def is_suite(geometry: settings.Geometry) -> bool:
    """Returns whether the homes are evaluated by source."""
    return geometry.name == components.SUITE


def each_source(geometry: settings.Geometry) -> str:
    """Returns what titles say of a suite."""
    return " in each source" if is_suite(geometry) else ""


def parts_of(geometry: settings.Geometry, homes: list) -> list[tuple[str | None, list]]:
    """Returns [(source, its homes)] of a suite, and [(None, homes)] of all other geometries."""
    if not is_suite(geometry):
        return [(None, homes)]
    parts = {}
    for home in homes:
        parts.setdefault(home["source"], []).append(home)
    return [*parts.items()]


def of_source(source: str | None, rows: list[dict]) -> list[dict]:
    """Returns rows of a table with their source, if it has a name."""
    return [{**row, "source": source} for row in rows] if source else rows


def count_homes(rows: list[dict]) -> int:
    """Returns the number of homes of the first agent or opponent, over all sources."""
    by_source = {}
    for row in rows:
        by_source.setdefault(row.get("source"), row["homes"] or 0)
    return by_source.get(None) or sum(by_source.values())


def with_worst_source(rows: list[dict], who: str) -> list[dict]:
    """Returns the rows of each agent or opponent, row[who], together, with that of its worst source
    once more at their end.
    """
    ordered = []
    for name in dict.fromkeys(row[who] for row in rows):
        of_one = [row for row in rows if row[who] == name]
        whole = [row for row in of_one if not {"role", "tail"} & row.keys()]
        worst = min(whole, key=statistics.score_of)
        ordered += [*of_one, {**worst, "is_worst": True}]
    return ordered
