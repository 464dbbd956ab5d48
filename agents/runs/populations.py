"""What a population leaves on disk: a run folder per member, `member-0`, `member-1`, ..., and
`population.jsonl`, with a line for each member of each generation.
"""

import contextlib
import itertools
from pathlib import Path

from megastep.agents.errors import UserError, user_errors
from megastep.agents.runs import checkpoint, config_yaml, json_lines, scores, typed_json
from megastep.agents.types import Row

FILE, PREFIX, KEY = "population.jsonl", "member-", "settings/"
#: What `population.score` may be beside the name of an episode statistic.
RUNNING, EVALUATED = "running", "evaluated"
INIT = "init=RUN starts a new run from the best member's weights"


def folder_of(root: Path, member: int) -> Path:
    """Returns the run folder of a member."""
    return root / f"{PREFIX}{member}"


def members(root: Path) -> list[Path]:
    """Returns the run folders of all members, in their order."""
    paths = (folder_of(root, n) for n in itertools.count())
    return [*itertools.takewhile(Path.is_dir, paths)]


def score_of(folder: Path, ranked_by: str = RUNNING) -> float | None:
    """Returns a member's last evaluated, else mean return, or what its population ranks by."""
    rows = json_lines.read(folder / "metrics.jsonl", typed_json.Metrics)
    if ranked_by not in (RUNNING, EVALUATED):
        return scores.mean(rows, ranked_by)
    evaluated = [row["eval/return"] for row in rows if row.get("eval/return") is not None]
    return evaluated[-1] if evaluated else scores.mean(rows)


def best(root: Path) -> int | None:
    """Returns the number of the first member with the highest score; None if none has one."""
    ranked_by, path = RUNNING, folder_of(root, 0) / "config.yaml"
    with contextlib.suppress(KeyError, TypeError):
        ranked_by = config_yaml.read(path)["population"]["score"] if path.exists() else RUNNING
    found = [score_of(folder, ranked_by) for folder in members(root)]
    known = [score for score in found if score is not None]
    return found.index(max(known)) if known else None


def member(root: Path, which: int | str = "best") -> Path:
    """Returns the run folder of a member, by its number or `best`. UserError for others."""
    n = len(members(root))
    if (number := best(root) if which == "best" else int(which)) is None:
        text = f"No member of {root} has a score, so none is the best"
        raise UserError(f"{text}; choose one with member=, 0 to {n - 1}")
    if not 0 <= number < n:
        raise UserError(
            f"{root} has no member {which}; its members are 0 to {n - 1}, and member=best"
        )
    return folder_of(root, number)


def common_checkpoints(root: Path) -> list[Path]:
    """Returns all members' newest intact checkpoints of one step; none if some have no first."""
    by_step = []
    for folder in members(root):
        paths = checkpoint.list_checkpoints(folder / "checkpoints")
        by_step.append({checkpoint.step_of(path): path for path in paths})
    common = set.intersection(*map(set, by_step))
    if not common and len(set.union(*map(set, by_step))) <= 1:
        return []
    for step in sorted(common, reverse=True):
        paths = [paths[step] for paths in by_step]
        if all(map(checkpoint.is_intact, paths)):
            return paths
    raise UserError(
        f"{root} cannot be resumed: its members have no intact checkpoint after the same number "
        f"of samples; {INIT}"
    )


def beginning(root: Path) -> checkpoint.Checkpoint:
    """Returns what the first member begins with, as a checkpoint without a state. UserError."""
    path = folder_of(root, 0) / "config.yaml"
    config = {"train": config_yaml.read(path), "spaces": {}}
    with user_errors(f"{path} cannot be read: "):
        typed_json.check(typed_json.Config, config)
    numbers: dict[str, float] = dict(samples=0, seconds=0, updates=0)
    return checkpoint.Checkpoint(path, 0, numbers, config, {})


def read(path: Path) -> list[list[Row]]:
    """Returns the rows of `population.jsonl` by generation and member. UserError."""
    with user_errors(f"{path} does not hold the generations of a population; {INIT}: "):
        rows = json_lines.read(path)
        typed_json.check(list[typed_json.Generation], rows)
        groups = [[*g] for _, g in itertools.groupby(rows, lambda row: row["generation"])]
        groups = [group for group in groups if len(group) == len(groups[0])]  # a kill cuts the last
        for group in groups:
            n, keys = len(groups[0]), settings_of(groups[0][0]).keys()
            are_right = (
                row["member"] == i and row["from"] < n and settings_of(row).keys() == keys
                for i, row in enumerate(group)
            )
            if not all(are_right):
                raise ValueError(f"generation {group[0]['generation']} is not like the first")
        return groups


def first_copy(folder: Path) -> int | None:
    """Returns the generation in which a member first copied another; None if it is not known."""
    with contextlib.suppress(UserError, ValueError, IndexError):
        number = int(folder.name.removeprefix(PREFIX))
        rows = [rows[number] for rows in read(folder.parent / FILE)]
        return next((row["generation"] for row in rows if row["from"] != row["member"]), None)


def settings_of(row: Row) -> dict[str, float]:
    """Returns the settings in a row, by key."""
    return {key[len(KEY) :]: value for key, value in row.items() if key.startswith(KEY)}


def lineage(generations: list[list[Row]], member: int) -> list[int]:
    """Returns the ancestor of a member after each generation, up to itself after the last."""
    line = [member]
    for rows in reversed(generations[1:]):
        line.append(rows[line[-1]]["from"])
    return line[::-1]
