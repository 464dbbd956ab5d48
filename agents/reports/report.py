"""A report of runs as one HTML file that opens from disk: what it was, curves, evaluations, homes.

Charts are drawn by uPlot (MIT, https://github.com/leeoniya/uPlot), which the page contains.
"""

import html
import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from megastep.agents import console
from megastep.agents.errors import user_errors
from megastep.agents.evaluation import tables
from megastep.agents.reports import homes, populations, runs, seeds
from megastep.agents.runs import checkpoint
from megastep.atomic_files import write_atomically

if TYPE_CHECKING:
    from megastep.agents.types import Row

HERE = Path(__file__).parent
#: Most points of a curve.
N_POINTS = 600
#: Metrics in the order of their charts, by how they begin; others follow.
ORDER = ("episode/return", "episode/", "loss/", "perf/rate", "perf/")
#: What the table of several runs says of its numbers.
METHOD = """Of each run, the mean return of its last reports. IQM: the interquartile mean over seeds
with a bootstrap interval; below, performance profiles: the fraction of seeds whose return is
above a threshold (Agarwal et al. 2021)."""
#: Metrics that are no curves to look at.
NOT_DRAWN = ("episode/count", "episode/window", "updates")


def write(paths: Sequence[Path], file: Path) -> Path:
    """Writes the report of runs into a file, and returns its path.

    Raises:
        UserError: a folder is no run, runs share no metric, or the file cannot be written.
    """
    every = [*map(runs.read, paths)]
    charts: list[Row] = []
    body = _one(every[0], charts, file) if len(every) == 1 else _several(every, charts)
    title = every[0].folder.name if len(every) == 1 else f"{len(every)} runs"
    parts = {
        "TITLE": _text(title),
        "UPLOT_CSS": (HERE / "uPlot.min.css").read_text(),
        "UPLOT_JS": (HERE / "uPlot.iife.min.js").read_text(),
        # the text of a script ends at the first </script
        "CHARTS": json.dumps(charts, separators=(",", ":")).replace("<", "\\u003c"),
        "BODY": body,
    }
    page = (HERE / "page.html").read_text("utf-8")
    for name, part in parts.items():
        page = page.replace(f"\n{name}\n", f"\n{part}\n", 1).replace(f">{name}<", f">{part}<", 1)
    with user_errors(f"{file} cannot be written: "):
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, page.encode())
    return file


# ---- One run ----


def _one(run: runs.Run, charts: list, file: Path) -> str:
    """Returns the body of a report of one run. Appends its charts."""
    samples = run.metrics[-1]["samples"]
    seconds = run.perf[-1].get("perf/seconds", 0) if run.perf else 0
    score, parts = run.score(), [f"<h1>{_text(run.folder.name)}</h1>"]
    result = f"{samples:,} samples in {console.duration(seconds)}"
    if score is not None:
        result += f", mean return {score:.4g} in training"
    parts += [f"<p>{_text(run.task)}</p>", f'<p class="result">{_text(result)}</p>']
    parts += ["<h2>What it was</h2>", _facts(run)]
    if rows := _evaluations(run):
        parts += ["<h2>Evaluations</h2>", *rows]
    parts += homes.section(run)
    parts += ["<h2>Curves</h2>", _charts(_drawn(run), [([run], "")], charts)]
    parts += _films(run, file)
    parts += ["<h2>Checkpoints</h2>", _checkpoints(run)]
    return "\n".join(parts)


def _facts(run: runs.Run) -> str:
    facts = {}
    for row in run.provenance[-1:]:
        shown = "command", "time", "commit", "megastep", "torch", "python", "device"
        facts = {name: row[name] for name in shown if row.get(name)}
    if len(run.provenance) > 1:
        facts["resumed"] = f"{len(run.provenance) - 1} times"
    facts |= {f"{k}": v for k, v in typed(run).items()}
    return _table([], [[key, str(value)] for key, value in facts.items()], heads=True)


def typed(run: runs.Run) -> "Row":
    """Returns the settings that the command of a run's first start named, as the run has them."""
    words = str(run.provenance[0].get("command", "")).split() if run.provenance else []
    keys = {word.lstrip("-+").partition("=")[0] for word in words if "=" in word}
    chosen = dict(runs.leaves(run.config))
    return {key: value for key, value in chosen.items() if key in keys}


def _evaluations(run: runs.Run) -> list[str]:
    parts = []
    for table in run.evaluations:
        make = tables.duel_cells if "won" in table["rows"][0] else tables.cells
        try:
            cells = [make(row) for row in table["rows"]]
            rows = [[*map(str, row.values())] for row in cells]
        except (KeyError, TypeError, ValueError, AttributeError):
            continue  # of another version, or a stranger's
        parts += [f"<p>{_text(str(table.get('title', '')))}</p>", _table([*cells[0]], rows)]
    return parts


def _films(run: runs.Run, file: Path) -> list[str]:
    films = sorted(run.folder.glob("*.mp4"))
    links = [os.path.relpath(film, file.parent) for film in films]
    shown = [f'<video controls loop muted src="{_text(link)}"></video>' for link in links]
    return ["<h2>Films</h2>", *shown] if shown else []


def _checkpoints(run: runs.Run) -> str:
    rows = []
    for path in checkpoint.list_checkpoints(run.folder / "checkpoints"):
        n_bytes = sum(part.stat().st_size for part in path.glob("*") if part.is_file())
        rows.append([path.name, f"{checkpoint.step_of(path):,}", f"{n_bytes / 1e6:.1f} MB"])
    return _table(["checkpoint", "samples", "size"], rows) if rows else "<p>None is kept.</p>"


# ---- Several runs ----


def _several(every: list[runs.Run], charts: list) -> str:
    """Returns the body of a report that compares runs. Appends its charts."""
    groups = runs.groups_of(every)
    tasks = ", ".join(sorted({run.task for run in every}))
    parts = [f"<h1>{len(every)} runs</h1>", f"<p>{_text(tasks)}</p>"]
    head = ["runs", "seeds", "IQM of the return", "95 % interval", "mean", "samples"]
    rows, scored = [], {}
    for name, group in groups.items():
        values = [score for run in group if (score := run.score()) is not None]
        samples = max(run.metrics[-1]["samples"] for run in group)
        cells = [name, str(len(group))]
        if values:
            scored[name] = values
            middle, lower, upper = seeds.interval([values])
            cells += [f"{middle:.4g}", f"{lower:.4g} to {upper:.4g}", f"{np.mean(values):.4g}"]
        rows.append([*cells, *["none"] * (5 - len(cells)), f"{samples:,}"])
    parts += ["<h2>Results</h2>", _table(head, rows)]
    parts += [f"<p>{METHOD}</p>"]
    if keys := runs.differing(every):
        values = [[key, *(str(g[0].settings().get(key)) for g in groups.values())] for key in keys]
        parts += ["<h2>Settings that differ</h2>", _table(["setting", *groups], values)]
    parts += populations.section(every, charts, _table)
    parts += ["<h2>Curves</h2>"]
    parts += [_charts(_drawn(*every), [(group, name) for name, group in groups.items()], charts)]
    if scored:
        parts += ["<h2>Performance profiles</h2>", _profiles(scored, charts)]
    return "\n".join(parts)


def _profiles(scored: Mapping[str, list[float]], charts: list) -> str:
    every = np.concatenate([*scored.values()])
    limits = np.linspace(every.min() - 1e-9, every.max(), 200)
    lines = [
        dict(label=name, colour=i, is_bound=False, y=_plain(seeds.profile([values], limits)))
        for i, (name, values) in enumerate(scored.items())
    ]
    chart = dict(id="profiles", title="seeds above a return", x_label="return", sync="profiles")
    charts.append(chart | dict(x=_plain(limits), series=lines, bands=[]))
    return '<div class="grid"><div class="chart" id="profiles"></div></div>'


# ---- Charts and tables ----


def _drawn(*every: runs.Run) -> list[str]:
    """Returns the metrics that have charts, what matters first, without those that never change."""
    names = [name for name in runs.metrics_of(every) if name not in NOT_DRAWN]
    kept = [n for n in names if n in ORDER or len({y for r in every for y in r.curve(n)[1]}) > 1]
    rank = {n: next((i for i, start in enumerate(ORDER) if n.startswith(start)), 9) for n in kept}
    return sorted(kept, key=rank.__getitem__)


def _charts(names: list[str], groups: Sequence[tuple[list, str]], charts: list) -> str:
    """Returns the places of charts, a line per group in each, and appends the charts."""
    places = []
    for name in names:
        curves = [[run.curve(name) for run in group] for group, _ in groups]
        if not all(x for group in curves for x, _ in group):
            continue
        chart = dict(id=f"chart-{len(charts)}", title=name, x_label="samples", sync="samples")
        if len(groups) == len(curves[0]) == 1:
            x, y = _thinned(*curves[0][0])
            lines, bands = [dict(label=name, colour=0, is_bound=False, y=y)], []
        else:
            x, lines, bands = _averaged(curves, [label for _, label in groups])
        charts.append(chart | dict(x=x, series=lines, bands=bands))
        places.append(f'<div class="chart" id="{chart["id"]}"></div>')
    return f'<div class="grid">{"".join(places)}</div>'


def _averaged(curves: Sequence, labels: list[str]) -> tuple[list, list, list]:
    """Returns (x, lines, bands) of groups of curves, on one axis."""
    averaged = [seeds.band(group) for group in curves]
    x = np.unique(np.concatenate([one["x"] for one in averaged]))
    x = x[:: max(1, len(x) // N_POINTS)]
    lines, bands = [], []
    for i, (one, label) in enumerate(zip(averaged, labels, strict=True)):
        for name in ("mean", "upper", "lower"):
            y = np.interp(x, one["x"], one[name], left=np.nan, right=np.nan)
            text = label if name == "mean" else f"{label} {name}"
            lines.append(dict(label=text, colour=i, is_bound=name != "mean", y=_plain(y)))
        bands.append([3 * i + 2, 3 * i + 3, i])
    return _plain(x), lines, bands


def _thinned(x: Sequence[float], y: Sequence[float]) -> tuple[list, list]:
    """Returns at most `N_POINTS` points, each the mean of as many neighbours."""
    n = -(-len(x) // N_POINTS)
    chunks = range(0, len(x), n)
    return tuple(_plain([np.mean(v[i : i + n]) for i in chunks]) for v in (x, y))  # type: ignore


def _plain(values: Iterable[float]) -> list:
    """Returns numbers in six digits as JSON has them."""
    return [float(f"{v:.6g}") if math.isfinite(v) else None for v in values]


def _text(text: str) -> str:
    return html.escape(console.visible(text))


def _table(head: list[str], rows: Iterable[Sequence[str]], heads: bool = False) -> str:
    """Returns a table.

    Args:
        heads: the first cell of each row is its head.
    """
    lines = ["".join(f"<th>{_text(cell)}</th>" for cell in head)] if head else []
    for first, *others in rows:
        cell = f"<th>{_text(first)}</th>" if heads else f"<td>{_text(first)}</td>"
        lines.append(cell + "".join(f"<td>{_text(other)}</td>" for other in others))
    inside = "\n".join(f"<tr>{line}</tr>" for line in lines)
    return f'<div class="wide"><table>{inside}</table></div>'
