"""Scores of runs and evaluations."""

from pathlib import Path

from megastep.agents.errors import user_errors
from megastep.agents.runs import json_lines, typed_json
from megastep.agents.types import Row

#: Settings of an evaluation in another environment or in other homes than those in training.
OTHERWISE = "env", "geometry", "greedy", "against", "max_steps"


def mean(rows: list[Row], name: str = "return", n_reports: int = 10) -> float | None:
    """Returns the mean of a statistic over the last reports, each episode once, or None."""
    total, n_episodes, end = 0.0, 0, len(rows)
    while end > max(0, len(rows) - n_reports):
        n_in_mean = rows[end - 1].get("episode/window", 0)
        value = rows[end - 1].get(f"episode/{name}")
        if n_in_mean and value is not None:
            total += n_in_mean * value
            n_episodes += n_in_mean
        end, n_before = end - 1, n_in_mean - rows[end - 1].get("episode/count", 0)
        while end > 0 and n_before > 0:  # their episodes are part of that window
            end, n_before = end - 1, n_before - rows[end - 1].get("episode/count", 0)
    return total / n_episodes if n_episodes else None


def evaluation(file: Path) -> Row:
    """Returns the contents of one of `evaluations/*.json`. Raises UserError if it is another."""
    with user_errors(f"{file} is not an evaluation: "):
        return typed_json.loads(file.read_bytes(), typed_json.Evaluation)


def outcome(result: Path, metric: str = "episode/return") -> dict[str, float | None]:
    """Returns `score`, `evaluated`, `lower`, `upper` of a run's folder or an evaluation's .json."""
    files, rows = [result], []
    kind, _, name = metric.partition("/")
    if is_run := result.is_dir():
        files = sorted(result.glob("evaluations/*.json"), key=lambda file: -file.stat().st_mtime)
        rows = json_lines.read(result / "metrics.jsonl", typed_json.Metrics)
    tables = [evaluation(file)["rows"][0] for file in files if file.suffix == ".json"]
    row = next((row for row in tables if not is_run or "return" in row), {})
    if name != "return" and "return" in row:
        row = row["metrics"].get(name, {"mean": row.get(name)})  # the second of `length`
    evaluated = row.get("mean", row.get("return", row.get("won")))
    score = mean(rows, name) if is_run and kind == "episode" else evaluated
    if score is None and kind == "eval":  # of the last evaluation in training
        score = next((row[metric] for row in reversed(rows) if metric in row), None)
    return dict(score=score, evaluated=evaluated, lower=row.get("lower"), upper=row.get("upper"))
