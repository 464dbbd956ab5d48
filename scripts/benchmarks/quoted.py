"""Writes the figures that README.md and docs/ quote from records.

    <!-- quote: explorer-step -->178.6 M<!-- end -->

docs/lab/quoted.yaml says which record a name stands for. `benchmark.py report` writes what is
between the two comments; a test compares.
"""

import functools
import re
import statistics
from pathlib import Path
from typing import Any

import paths
import records
import yaml

from megastep.agents.runs import agent_file

QUOTES = paths.LAB / "quoted.yaml"
ROWS = paths.ROOT / "agents" / "cli" / "reproductions.yaml"
AGENTS = paths.ROOT / "agents" / "pretrained"
#: The pages that quote: all but the lab notes, which are the evidence.
PAGES = [paths.ROOT / "README.md", *sorted((paths.ROOT / "docs").glob("*.md"))]
PAGES += sorted((paths.ROOT / "docs/concepts").glob("*.md"))
MARKED = re.compile(r"(<!-- quote: ([\w-]+) -->)(.*?)(<!-- end -->)", re.S)


@functools.cache
def quotes() -> dict[str, Any]:
    return yaml.safe_load(QUOTES.read_text())


@functools.cache
def _newest():
    return records.newest(records.read(paths.RECORDS))


@functools.cache
def _rows():
    return yaml.safe_load(ROWS.read_text())["rows"]


def text_of(name: str) -> str:
    """Returns the text of a quote.

    Raises:
        ValueError: if it has no record, or a lab note does not say what it quotes.
    """
    if name not in quotes():
        raise ValueError(f"docs/lab/quoted.yaml has no {name}")
    quote = quotes()[name]
    if "row" in quote:
        stated = _rows()[quote["row"]]["results"]
        values = {key: text for result in stated for key, text in result["states"].items()}
        return values[quote["states"]].partition(" ")[0]
    if "page" in quote:
        lines = (paths.LAB / quote["page"]).read_text().splitlines()
        if not any(quote["line"] in line and quote["says"] in line for line in lines):
            raise ValueError(f"{name}: {quote['page']} does not say {quote['says']}")
        return quote.get("as", quote["says"])
    if "rows" in quote:
        return _table(quote)
    if "agent" in quote:
        return quote["as"].format(**_results(quote["agent"], quote.get("source")))
    return _formatted(quote["what"], quote["card"], quote["as"])


def _results(agent, source):
    """Returns the means of a trained agent, in a source of homes if any, from its file."""
    tables = agent_file.read_metadata(AGENTS / f"{agent}{agent_file.SUFFIX}")["tables"]
    row = next(row for table in tables for row in table["rows"] if row.get("source") == source)
    return row | {name: metric["mean"] for name, metric in row.get("metrics", {}).items()}


def _table(quote):
    """Returns a Markdown table with a cell for each row and column."""
    lines = [[quote["head"], *quote["columns"]], ["---"] * (1 + len(quote["columns"]))]
    for title, row in quote["rows"].items():
        cells = [title]
        for column in quote["columns"].values():
            found = [one.format(row=row, column=column) for one in quote["cell"]]
            cells.append(", ".join(_formatted(one, quote["card"], quote["as"]) for one in found))
        lines.append(cells)
    return "\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n\n"


def _formatted(what, card, form):
    """Returns the text about the newest records whose name is `what`, a regular expression.

    `form` has `{value}`, the median of their values; `{low}`, `{high}` and `{n}` of them; `{lower}`
    and `{upper}`, the interval of a single one, and `{half}` of it; `{on}`, `{commit}` and
    `{date}`. By unit, if it is a dict.
    """
    found = [r for r in _newest() if re.fullmatch(what, r["what"]) and r["on"].startswith(card)]
    if not found:
        raise ValueError(f"no record of {what!r} on {card}")
    form = form if isinstance(form, str) else form[found[0]["unit"]]
    values, commits = [r["value"] for r in found], dict.fromkeys(r["commit"][:7] for r in found)
    lower, upper = found[0]["lower"], found[0]["upper"]
    return form.format(
        value=statistics.median(values),
        low=min(values),
        high=max(values),
        n=len(values),
        lower=lower,
        upper=upper,
        half=None if lower is None else (upper - lower) / 2,
        on=found[0]["on"],
        commit=", ".join(commits),
        date=max(r["date"] for r in found),
    )


def rewritten(page: str) -> str:
    """Returns the text of a page with its quotes as the records have them."""
    return MARKED.sub(lambda match: f"{match[1]}{text_of(match[2])}{match[4]}", page)


def write() -> None:
    """Rewrites the pages that quote."""
    for path in PAGES:
        text = path.read_text()
        if (new := rewritten(text)) != text:
            path.write_text(new)


def names(path: Path) -> list[str]:
    """Returns the names that a page quotes."""
    return [match[2] for match in MARKED.finditer(path.read_text())]
