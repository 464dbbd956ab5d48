"""What a run or an evaluation achieved, in one number."""

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING

from megastep.agents.runs import json_lines

if TYPE_CHECKING:
    from megastep.agents.types import Row


def mean_return(rows: "list[Row]", n_reports: int = 10) -> float | None:
    """Returns the score of a training run from its metrics, None if no episode finished.

    It is the mean return of the episodes that ended in the last reports, or of some more if they
    are fewer than a report's means are over (`training.episode_stats`). Each counts once, so a
    report of one lucky episode has the weight of one.
    """
    total, n_episodes, end = 0.0, 0, len(rows)
    while end > max(0, len(rows) - n_reports):
        n_in_mean = rows[end - 1].get("episode/window", 0)
        if n_in_mean:
            total += n_in_mean * rows[end - 1]["episode/return"]
            n_episodes += n_in_mean
        end, n_before = end - 1, n_in_mean - rows[end - 1].get("episode/count", 0)
        while end > 0 and n_before > 0:  # these reports are in that mean already
            end, n_before = end - 1, n_before - rows[end - 1].get("episode/count", 0)
    return total / n_episodes if n_episodes else None


def outcome(result: Path) -> dict[str, float | None]:
    """Returns what a job achieved, from what it returned.

    score: for a sweeper: a training run's `mean_return`, an evaluation's return, the share of duels
        won against the first opponent.
    evaluated, lower, upper: the evaluated one of these with its interval; of a run its return.
    """
    files, rows = [result], []
    if is_run := result.is_dir():
        files = sorted(result.glob("evaluations/*.json"))
        with contextlib.suppress(OSError):
            rows = json_lines.read(result / "metrics.jsonl")
    tables = [json.loads(file.read_text())["rows"][0] for file in files if file.suffix == ".json"]
    row = next((row for row in tables if not is_run or "return" in row), {})
    evaluated = row.get("return", row.get("won"))
    score = mean_return(rows) if is_run else evaluated
    return dict(score=score, evaluated=evaluated, lower=row.get("lower"), upper=row.get("upper"))
