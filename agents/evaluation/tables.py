"""Tables of evaluations: where they were made, and the files that hold them."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from megastep.agents import console
from megastep.agents.evaluation.eval_env import EvalEnv
from megastep.agents.factory.check import as_tree
from megastep.agents.factory.components import SUITE, env_name, label
from megastep.agents.factory.settings import Evaluate, Geometry
from megastep.agents.runs import checkpoint, folders
from megastep.agents.runs.typed_json import encoded

INTERVAL = "95 % interval"


def title_of(where: EvalEnv, geometry: Geometry, split: str, what: str, n_homes: int | None) -> str:
    """`minimal: 1,024 episodes in 512 homes, geometry=homes, split=test`."""
    homes = f" in {n_homes:,} home{'s' * (n_homes > 1)}" if n_homes else ""
    text = f"{env_name(where.settings)}: {what}{homes}"
    if not where.homes:
        return text
    name = label(geometry.name) if geometry.name.startswith("megastep.") else geometry.name
    file = Path(getattr(geometry, "path", None) or "").name
    return f"{text}, geometry={name}{f' ({file})' * bool(file)}, split={split}"


def source_of(where: EvalEnv, geometry: Geometry) -> str:
    """Returns the source of the homes, or the environment if there are none, for file names."""
    if not where.homes:
        return env_name(where.settings)
    file = Path(getattr(geometry, "path", None) or "").stem
    return "-".join(filter(None, [label(geometry.name), file]))


def write_table(
    cfg: Evaluate,
    loaded: checkpoint.Checkpoint,
    names: list[str],
    title: str,
    rows: list,
    differences: list,
    episodes: Sequence[Mapping],
) -> Path:
    """Prints a table, ended by `differences`, and writes it into the run's folder `evaluations`: as
    .md, as .csv of `episodes`, and as .json, whose path it returns.
    """
    names = [name for name in (*names, "greedy" * cfg.greedy) if name]
    file = folders.folder_of(loaded.path) / "evaluations" / folders.for_file("-".join(names))[:200]
    result = dict(title=title, checkpoint=str(loaded.path), step=loaded.step)
    result |= dict(evaluation=encoded(as_tree(cfg)), rows=rows)
    result |= {"differences": differences} if differences else {}
    text = json.dumps(result, indent=2)
    shown = grid([*rows, *differences])
    files = {"md": f"{title}\n\n{console.table(*shown, is_markdown=True)}\n"}
    if episodes:
        keys = dict.fromkeys(key for row in episodes for key in row)
        columns = {key: [row.get(key) for row in episodes] for key in keys}
        text = f'{text[:-2]},\n  "episodes": {json.dumps(columns)}\n}}'  # on one line
        files["csv"] = console.as_csv([*keys], zip(*columns.values(), strict=True))
    console.say(f"{title}\n{console.table(*shown, width=console.terminal_width())}")
    files["json"] = text
    folders.write({Path(f"{file}.{ending}"): content for ending, content in files.items()})
    return Path(f"{file}.json")


def grid(rows: Sequence[dict]) -> tuple[list[str], list[list[str]]]:
    """Returns the head and the lines of a table, of evaluations or of duels."""
    shown = [*map(duel_cells if "won" in rows[0] else cells, rows)]
    return [*shown[0]], [[*row.values()] for row in shown]


def cells(row: dict) -> dict[str, str]:
    """Returns the cells of an agent's evaluation, by column."""
    cut, metrics = f", {row['unfinished']} cut short" if row["unfinished"] else "", {}
    for name, metric in row["metrics"].items():
        texts = [f"{value:.3g}" for value in metric.values() if value is not None] or 2 * ["none"]
        metrics |= {name: texts[0], f"{name}: {INTERVAL}": " to ".join(texts[1:])}
    return {
        "agent": f"{row['agent']}{part_of(row)}",
        "return": f"{row['return']:.2f}",
        INTERVAL: f"{row['lower']:.2f} to {row['upper']:.2f}",
        **metrics,
        "length": f"{row['length']:.0f}",
        "episodes": f"{row['lanes']}{cut}",
        "homes": str(row["homes"] or "none"),
    }


def duel_cells(row: dict) -> dict[str, str]:
    """Returns the cells of an opponent's duels, by column."""
    return {
        "against": f"{row['against']}{part_of(row).replace(': ', ', as ')}",
        "won": f"{row['won']:.3f}",
        INTERVAL: f"{row['lower']:.3f} to {row['upper']:.3f}",
        **{name: str(row[name]) for name in ("wins", "draws", "losses")},
        "length": f"{row['length']:.0f}",
        "duels": str(row["duels"]),
        "homes": str(row["homes"] or "none"),
    }


def part_of(row: dict) -> str:
    """Returns which of its agent's episodes a row has, `: hunter` or `, in maze`; empty for all."""
    role = f": {row['role']}" if "role" in row else ""
    return role + (f", in {row['source']}" if "source" in row else "")


# ---- Suites: geometries of several sources, which are evaluated one by one ----


def parts_of(geometry: Geometry, homes: list) -> list[tuple[str | None, list]]:
    """Returns [(source, its homes)] of a suite, and [(None, homes)] of all other geometries."""
    if geometry.name != SUITE:
        return [(None, homes)]
    parts = {}
    for home in homes:
        parts.setdefault(home["source"], []).append(home)
    return [*parts.items()]
