"""Tables of evaluations: where they were made, and the files that hold them."""

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from megastep.agents import console
from megastep.agents.errors import user_errors
from megastep.agents.evaluation.eval_env import EvalEnv
from megastep.agents.evaluation.statistics import score_of
from megastep.agents.factory import components
from megastep.agents.factory.check import as_tree
from megastep.agents.factory.settings import Evaluate, Geometry, env_name, label
from megastep.agents.runs import checkpoint
from megastep.agents.runs.folders import folder_of, for_file
from megastep.agents.runs.typed_json import encoded
from megastep.atomic_files import write_atomically

INTERVAL = "95 % interval"
#: The source of a suite of which the worst homes have a row of their own.
DENSE = "dense"


class Labels(NamedTuple):
    """Where a run is evaluated.

    Attributes:
        env: the environment's name.
        source: that of the homes, or of the environment if there are none, for file names.
        choice: the choice of homes, for titles; empty if there are none.
    """

    env: str
    source: str
    choice: str

    def title(self, what: str, n_homes: int | None) -> str:
        """Returns `minimal: 1,024 episodes in 512 homes, geometry=homes, split=test`.

        Args:
            what: such as `1,024 episodes`.
            n_homes: number of homes, if known.
        """
        homes = f" in {n_homes:,} home{'s' * (n_homes > 1)}" if n_homes else ""
        return f"{self.env}: {what}{homes}{self.choice}"


def labels(where: EvalEnv, geometry: Geometry, split: str) -> Labels:
    """Returns how tables name an environment and its homes."""
    env = where.settings
    if not where.homes:
        return Labels(env_name(env), env_name(env), "")
    path = Path(getattr(geometry, "path", None) or "")
    is_ours = geometry.name.startswith("megastep.")
    name = label(geometry.name) if is_ours else geometry.name
    choice = f", geometry={name}{f' ({path.name})' * bool(path.name)}, split={split}"
    return Labels(env_name(env), "-".join(filter(None, [label(geometry.name), path.stem])), choice)


def write_table(
    cfg: Evaluate,
    loaded: checkpoint.Checkpoint,
    names: list[str],
    title: str,
    rows: list,
    cells: list[dict],
    episodes: Sequence[Mapping] = (),
    n_ranks: int = 1,
) -> Path:
    """Prints a table, and writes it into the run's folder `evaluations`: `cells` for people, .md,
    and `rows` for programs, .json. Returns the latter's path.

    Args:
        episodes: a row per episode, for the .csv and, by column, the .json.
        n_ranks: number of ranks that played them.
    """
    names = [name for name in (*names, "greedy" * cfg.greedy) if name]
    folder, name = folder_of(loaded.path) / "evaluations", for_file("-".join(names))
    head, lines = [*cells[0]], [[*row.values()] for row in cells]
    result = dict(
        title=title,
        checkpoint=str(loaded.path),
        step=loaded.step,
        evaluation=encoded(as_tree(cfg)),
        ranks=n_ranks,
        rows=rows,
    )
    text = json.dumps(result, indent=2)
    if columns := columns_of(episodes):
        text = f'{text[:-2]},\n  "episodes": {json.dumps(columns)}\n}}'
    console.say(f"{title}\n{console.table(head, lines, width=console.terminal_width())}")
    with user_errors(f"{folder} cannot be written: "):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(
            folder / f"{name[:200]}.md",
            f"{title}\n\n{console.table(head, lines, is_markdown=True)}\n".encode(),
        )
        if columns:
            write_atomically(folder / f"{name[:200]}.csv", as_csv(episodes, [*columns]).encode())
        write_atomically(folder / f"{name[:200]}.json", text.encode())
    return folder / f"{name[:200]}.json"


def columns_of(rows: Sequence[Mapping]) -> dict[str, list]:
    """Returns {name: the values of all rows}, None where a row has none."""
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: [row.get(name) for row in rows] for name in names}


def as_csv(rows: Sequence[Mapping], columns: list[str]) -> str:
    """Returns rows as CSV; what is None is empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


#: Columns of a table of duels, and of one of ratings, as templates.
DUELS = {
    "against": "{against}",
    "won": "{won:.3f}",
    INTERVAL: "{lower:.3f} to {upper:.3f}",
    **{name: f"{{{name}}}" for name in ("wins", "draws", "losses")},
    "length": "{length:.0f}",
    "duels": "{duels}",
    "homes": "{homes}",
}


RATINGS = {
    "player": "{player}",
    "rating": "{rating:.2f}",
    "sigma": "{sigma:.2f}",
    "won": "{won:.3f}",
    "duels": "{duels}",
}


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


def part_of(row: dict) -> str:
    """Returns which of its agent's episodes a row has, `: hunter` or `, in maze`; empty for all."""
    worst = f", worst {row['tail']:.0%} of homes" if "tail" in row else ""
    worst += ", the worst source" * row.get("is_worst", False)
    role = f": {row['role']}" if "role" in row else ""
    return role + (f", in {row['source']}{worst}" if "source" in row else "")


def duel_cells(row: dict) -> dict[str, str]:
    """Returns the cells of an opponent's duels, by column."""
    against = f"{row['against']}{part_of(row).replace(': ', ', as ')}"
    row = row | {"against": against, "homes": row["homes"] or "none"}
    return {key: form.format_map(row) for key, form in DUELS.items()}


# ---- Suites: geometries of several sources, which are evaluated one by one ----


def is_suite(geometry: Geometry) -> bool:
    """Returns whether the homes are evaluated by source."""
    return geometry.name == components.SUITE


def parts_of(geometry: Geometry, homes: list) -> list[tuple[str | None, list]]:
    """Returns [(source, its homes)] of a suite, and [(None, homes)] of all other geometries."""
    if not is_suite(geometry):
        return [(None, homes)]
    parts = {}
    for home in homes:
        parts.setdefault(home["source"], []).append(home)
    return [*parts.items()]


def title_of(
    labels: Labels, geometry: Geometry, rows: list[dict], what: str
) -> tuple[str, list[dict]]:
    """Returns the title of a table, and its rows: of a suite with the worst source of each agent or
    opponent once more at its end.

    Args:
        what: the key of the number of episodes, `lanes` or `duels`.
    """
    who, name = ("agent", "episodes") if what == "lanes" else ("against", what)
    text = f"{rows[0][what]:,} {name}{' in each source' * is_suite(geometry)}"
    by_source = {}
    for row in rows:
        by_source.setdefault(row.get("source"), row["homes"] or 0)
    title = labels.title(text, by_source.get(None) or sum(by_source.values()))
    if not is_suite(geometry):
        return title, rows
    ordered = []
    for one in dict.fromkeys(row[who] for row in rows):
        of_one = [row for row in rows if row[who] == one]
        whole = [row for row in of_one if not {"role", "tail"} & row.keys()]
        ordered += [*of_one, {**min(whole, key=score_of), "is_worst": True}]
    return title, ordered
