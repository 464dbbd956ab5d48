"""A report of runs as one HTML file that opens from disk: what it was, curves, evaluations, homes.

Charts are drawn by uPlot (MIT, https://github.com/leeoniya/uPlot), which the page contains.
"""

import contextlib
import html
import itertools
import json
import math
import os
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from megastep.agents import console
from megastep.agents.errors import ConfigErrors, UserError
from megastep.agents.evaluation import tables
from megastep.agents.evaluation.statistics import SCORES
from megastep.agents.factory import check, components
from megastep.agents.factory import make as factory
from megastep.agents.reports import runs, seeds
from megastep.agents.runs import checkpoint, folders, populations, trust

HERE = Path(__file__).parent
#: Most points of a curve.
N_POINTS = 600
#: Metrics in the order of their charts, by how they begin; others follow.
ORDER = ("episode/return", "episode/", "loss/", "perf/rate", "perf/")
#: What the table of several runs says of its numbers.
METHOD = """Of each run, the mean return of its last reports. IQM: the interquartile mean over seeds
with a bootstrap interval; below, performance profiles: the fraction of seeds whose return is
above a threshold (Agarwal et al. 2021)."""
#: A line of the chart of a population's scores, and what it is of the members' scores.
SUMMARIES = {"best": np.nanmax, "median": np.nanmedian}
#: Homes that are drawn: so many of the worst, and of the best.
N_WORST, N_BEST = 36, 12
#: What an evaluation of another version, or of a stranger, may raise.
ODD = ArithmeticError, AttributeError, LookupError, StopIteration, TypeError, ValueError
#: Metrics that say nothing as curves.
NOT_DRAWN = ("episode/count", "episode/window", "updates")


def write(paths: Sequence[Path], file: Path) -> Path:
    """Writes the report of runs into a file, and returns its path. UserError."""
    every, charts = [*map(runs.read, paths)], Charts()
    body = _one(every[0], charts, file) if len(every) == 1 else _several(every, charts)
    parts = {
        "TITLE": _text(every[0].folder.name if len(every) == 1 else f"{len(every)} runs"),
        "UPLOT_CSS": (HERE / "uPlot.min.css").read_text(),
        "UPLOT_JS": (HERE / "uPlot.iife.min.js").read_text(),
        # the text of a script ends at the first </script
        "CHARTS": json.dumps(charts, separators=(",", ":")).replace("<", "\\u003c"),
        "BODY": "\n".join(body),
    }
    page = (HERE / "page.html").read_text("utf-8")
    for name, part in parts.items():
        page = page.replace(f"\n{name}\n", f"\n{part}\n", 1).replace(f">{name}<", f">{part}<", 1)
    folders.write({file: page})
    return file


# ---- One run ----


def _one(run: runs.Run, charts: "Charts", file: Path) -> list[str]:
    """Returns the body of a report of one run. Adds its charts."""
    seconds = run.perf[-1].get("perf/seconds", 0) if run.perf else 0
    result = f"{run.metrics[-1]['samples']:,} samples in {console.duration(seconds)}"
    if (score := run.score()) is not None:
        result += f", mean return {score:.4g} in training"
    parts = [f"<h1>{_text(run.folder.name)}</h1>", f"<p>{_text(run.task)}</p>"]
    parts += [f'<p class="result">{_text(result)}</p>', "<h2>What it was</h2>"]
    parts += [_table([], [[key, str(value)] for key, value in _facts(run).items()], heads=True)]
    tables_of_run = []
    for table in run.evaluations:
        with contextlib.suppress(*ODD):  # of another version, or a stranger's
            head, rows = tables.grid([*table["rows"], *table.get("differences", ())])
            tables_of_run += [f"<p>{_text(table['title'])}</p>", _table(head, rows)]
    parts += ["<h2>Evaluations</h2>", *tables_of_run] if tables_of_run else []
    parts += section(run)
    parts += ["<h2>Curves</h2>", _curves([run], [([run], "")], charts)]
    films = [os.path.relpath(film, file.parent) for film in sorted(run.folder.glob("*.mp4"))]
    shown = [f'<video controls loop muted src="{_text(link)}"></video>' for link in films]
    parts += ["<h2>Films</h2>", *shown] if shown else []
    rows = []
    for path in checkpoint.list_checkpoints(run.folder / "checkpoints"):
        n_bytes = sum(part.stat().st_size for part in path.glob("*") if part.is_file())
        rows.append([path.name, f"{checkpoint.step_of(path):,}", f"{n_bytes / 1e6:.1f} MB"])
    kept = _table(["checkpoint", "samples", "size"], rows) if rows else "<p>None is kept.</p>"
    return [*parts, "<h2>Checkpoints</h2>", kept]


def _facts(run) -> dict[str, object]:
    """Returns the command, versions, and the settings that the first command named."""
    if not run.provenance:
        return {}
    first, last = run.provenance[0], run.provenance[-1]
    shown = "command", "time", "commit", "megastep", "torch", "python", "device"
    facts = {name: last[name] for name in shown if last.get(name)}
    command = str(first.get("command", ""))
    if len(run.provenance) > 1:
        times = f"{len(run.provenance) - 1} times, last after {last['samples']:,} samples"
        facts |= {"command": command, "resumed": times, "last command": last.get("command", "")}
    keys = {word.lstrip("-+").partition("=")[0] for word in command.split() if "=" in word}
    return facts | {key: value for key, value in runs.leaves(run.config) if key in keys}


# ---- Its homes, drawn from above and coloured by what was earned in them ----


def section(run: runs.Run) -> list[str]:
    """Returns the HTML that shows where the agent does badly; empty without several homes."""
    for table in run.evaluations:
        if "home" not in table.get("episodes", {}):
            continue
        try:
            name, by_home = score_by_home(table["episodes"])
            loaded = folders.load_checkpoint(folders.find(str(run.folder)), False, "cpu")
            trained, chosen = factory.config_of(loaded), table["evaluation"]
            geometry = trained.geometry
            if typed := chosen.get("geometry"):
                trust.check({"train": {"geometry": typed}}, "An evaluation", "")
                kind = components.kind_of("geometry", str(typed["name"]))
                geometry = check.check(kind, typed)
            plans = factory.homes(trained.env, geometry, str(chosen["split"]))
        except (UserError, ConfigErrors, *ODD) as error:
            return [f"<p>Homes are not drawn: {_text(str(error))}</p>"]
        worst = sorted(by_home, key=by_home.__getitem__)
        if len(worst) < 2 or not all(0 <= home < len(plans) for home in worst):
            continue
        span = by_home[worst[0]], by_home[worst[-1]]
        drawn = worst[:N_WORST] + worst[max(N_WORST, len(worst) - N_BEST) :]
        n_left = len(worst) - len(drawn)
        text = (
            f"{table['title']}. By {name}, worst first: {span[0]:.3g} to {span[1]:.3g} in "
            f"{len(worst):,} homes{f'; {n_left:,} between them are not drawn' * (n_left > 0)}."
        )
        shown = [figure(home, plans[home], by_home[home], span) for home in drawn]
        return [
            "<h2>Homes, worst first</h2>",
            f"<p>{_text(text)} <code>record.py home=N</code> films one of this split.</p>",
            f'<div class="plans">{"".join(shown)}</div>',
        ]
    return []


def score_by_home(episodes: Mapping[str, Sequence]) -> tuple[str, dict[int, float]]:
    """Returns the first of `SCORES` that episodes have, and its mean by home, of one agent."""
    name = next(name for name in SCORES if any(v is not None for v in episodes.get(name, ())))
    agents, values = episodes["agent"], defaultdict(list)
    for agent, home, value in zip(agents, episodes["home"], episodes[name], strict=True):
        if agent == agents[0] and home is not None and value is not None:
            values[int(home)].append(float(value))
    return name, {home: float(np.mean(some)) for home, some in values.items()}


def figure(number: int, plan: Mapping, value: float, span: tuple[float, float]) -> str:
    """Returns a home from above, its floor coloured by a value between the bounds of `span`."""
    walls = np.asarray(plan["walls"], float)
    low, high = walls.min((0, 1)), walls.max((0, 1))
    lines = "".join(
        f"M{a[0] - low[0]:.2f} {high[1] - a[1]:.2f}L{b[0] - low[0]:.2f} {high[1] - b[1]:.2f}"
        for a, b in walls
    )
    width, height = high - low
    fraction = (value - span[0]) / (span[1] - span[0]) if span[1] > span[0] else 1.0
    # from a dark red to a light green: lightness differs as well
    hue, saturation, lightness = 10 + 110 * fraction, 70 - 15 * fraction, 48 + 20 * fraction
    colour = f"hsl({hue:.0f} {saturation:.0f}% {lightness:.0f}%)"
    box = f"-.3 -.3 {width + 0.6:.2f} {height + 0.6:.2f}"
    floor = f'<rect width="{width:.2f}" height="{height:.2f}" fill="{colour}"/>'
    drawing = f'<svg viewBox="{box}" role="img">{floor}<path d="{lines}"/></svg>'
    return f"<figure>{drawing}<figcaption>{number}: {value:.3g}</figcaption></figure>"


# ---- Several runs ----


def _several(every: list[runs.Run], charts: "Charts") -> list[str]:
    """Returns the body of a report that compares runs. Adds its charts."""
    groups, left_out = runs.without_interrupted(runs.groups_of(every))
    tasks = "; ".join(dict.fromkeys(run.task for run in every))
    parts = [f"<h1>{len(every)} runs</h1>", f"<p>{_text(tasks)}</p>"]
    scores = {
        name: [score for run in group if (score := run.score()) is not None]
        for name, group in groups.items()
    }
    rows = seeds.pooled(scores)
    for row, group in zip(rows, groups.values(), strict=True):
        row.append(f"{max(run.metrics[-1]['samples'] for run in group):,}")
    head = [*(text.format("the return") for text in seeds.POOLED), "samples"]
    parts += ["<h2>Results</h2>", _table(head, rows), f"<p>{METHOD}</p>"]
    parts += [f"<p>{_text(sentence)}</p>" for sentence in left_out]
    if keys := runs.differing(every):
        values = [[key, *(str(g[0].settings().get(key)) for g in groups.values())] for key in keys]
        parts += ["<h2>Settings that differ</h2>", _table(["setting", *groups], values)]
    parts += _population(every, charts)
    named = [(group, name) for name, group in groups.items()]
    parts += ["<h2>Curves</h2>", _curves(every, named, charts)]
    if scored := {name: values for name, values in scores.items() if values}:
        values = np.concatenate([*scored.values()])
        limits = np.linspace(values.min() - 1e-9, values.max(), 200)
        lines = {name: seeds.profile([values], limits) for name, values in scored.items()}
        place = charts.add("seeds above a return", limits, lines, "return")
        parts += ["<h2>Performance profiles</h2>", f'<div class="grid">{place}</div>']
    return parts


def _population(every, charts) -> list[str]:
    """Returns the HTML about lineage, scores and settings of a population, if runs are one."""
    path = min(run.folder.parent for run in every) / populations.FILE
    if len({run.folder.parent for run in every}) > 1 or not path.is_file():
        return []
    generations = populations.read(path)
    n = len(every)
    generations = [rows for rows in generations if len(rows) == n]
    if n < 2 or not generations:
        return []
    lines = []
    for member, own in enumerate(zip(*generations)):
        copied = [f"{r['generation']} from {r['from']}" for r in own if r["from"] != member]
        line = itertools.groupby(populations.lineage(generations, member))
        ancestors = " → ".join(str(ancestor) for ancestor, _ in line)
        n_diverged = str(sum(int(row.get("diverged", 0)) for row in own))
        lines.append([str(member), ancestors, ", ".join(copied) or "never", n_diverged])
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
    places = [charts.add(title, x, series) for title, series in shown.items()]
    head = ["member", "descends from", "copied at generation", "diverged"]
    return [
        "<h2>Population</h2>",
        _table(head, lines),
        f'<div class="grid">{"".join(places)}</div>',
    ]


# ---- Charts and tables ----


class Charts(list):
    """What the charts of a page show."""

    def add(
        self,
        title: str,
        x: Iterable[float],
        lines: Mapping[str, Iterable],
        x_label: str = "samples",
    ) -> str:
        """Adds a chart, and returns its place. Lines are {label: y, or (mean, upper, lower)}."""
        series, bands = [], []
        for i, (label, y) in enumerate(lines.items()):
            bands += [[3 * i + 2, 3 * i + 3, i]] if isinstance(y, tuple) else []
            parts = y if isinstance(y, tuple) else (y,)
            for bound, values in zip(("", " upper", " lower"), parts):
                about = dict(label=f"{label}{bound}", colour=i, is_bound=bool(bound))
                series.append({**about, "y": _plain(values)})
        place = f"chart-{len(self)}"
        about = dict(id=place, title=title, x_label=x_label, sync=x_label, x=_plain(x))
        self.append({**about, "series": series, "bands": bands})
        return f'<div class="chart" id="{place}"></div>'


def _curves(every: Sequence[runs.Run], groups: Sequence[tuple[list, str]], charts: Charts) -> str:
    """Returns the places of charts of all metrics that change, a line per group in each."""
    names = [name for name in runs.metrics_of(every) if name not in NOT_DRAWN]
    kept = [n for n in names if n in ORDER or len({y for r in every for y in r.curve(n)[1]}) > 1]
    rank = {n: next((i for i, start in enumerate(ORDER) if n.startswith(start)), 9) for n in kept}
    places = []
    for name in sorted(kept, key=rank.__getitem__):
        curves = [[run.curve(name) for run in group] for group, _ in groups]
        if not all(x for group in curves for x, _ in group):
            continue
        if len(every) == 1:
            x, y = curves[0][0]
            n = -(-len(x) // N_POINTS)  # neighbours that are averaged
            x, y = ([np.mean(v[i : i + n]) for i in range(0, len(x), n)] for v in (x, y))
            places.append(charts.add(name, x, {name: y}))
            continue
        bands = [seeds.band(group) for group in curves]
        x, lines = np.unique(np.concatenate([band["x"] for band in bands])), {}
        x = x[:: max(1, len(x) // N_POINTS)]
        for band, (_, label) in zip(bands, groups, strict=True):
            at, *bounds = (band[key] for key in ("x", "mean", "upper", "lower"))
            lines[label] = tuple(np.interp(x, at, y, np.nan, np.nan) for y in bounds)
        places.append(charts.add(name, x, lines))
    return f'<div class="grid">{"".join(places)}</div>'


def _plain(values: Iterable[float]) -> list:
    """Returns numbers in six digits as JSON has them."""
    return [float(f"{v:.6g}") if math.isfinite(v) else None for v in values]


def _text(text: str) -> str:
    return html.escape(console.visible(text))


def _table(head: list[str], rows: Iterable[Sequence[str]], heads: bool = False) -> str:
    """Returns a table, with `heads` of rows whose first cell is their head."""
    lines = ["".join(f"<th>{_text(cell)}</th>" for cell in head)] if head else []
    for first, *others in rows:
        cell = f"<th>{_text(first)}</th>" if heads else f"<td>{_text(first)}</td>"
        lines.append(cell + "".join(f"<td>{_text(other)}</td>" for other in others))
    inside = "\n".join(f"<tr>{line}</tr>" for line in lines)
    return f'<div class="wide"><table>{inside}</table></div>'
