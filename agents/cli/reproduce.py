"""Makes results of docs/lab again, with `megastep train` and `megastep evaluate`."""

import itertools
import json
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import yaml

from megastep.agents import console, package
from megastep.agents.cli.command import Command
from megastep.agents.errors import UserError
from megastep.agents.runs import folders, json_lines
from megastep.settings import closest

HELP = """Makes results of docs/lab again.

  megastep reproduce          lists them
  megastep reproduce ROW      trains and evaluates one, and compares"""
#: {name: row}; its head says what a row consists of.
FILE = Path(__file__).with_name("reproductions.yaml")
#: Threads of rows for a CPU: as many as the stated results were made with.
CPU_THREADS = 2
#: A stated value and its interval, in percent or not.
STATED = re.compile(r"-?[\d.]+( %)? \((-?[\d.]+) to (-?[\d.]+)\)")


class Interval(NamedTuple):
    """A value and its 95 % interval."""

    value: float
    lower: float
    upper: float

    def __str__(self) -> str:
        return f"{self.value:.4g} ({self.lower:.4g} to {self.upper:.4g})"

    def agrees(self, stated: str) -> bool:
        """Returns true if it has a number in common with the stated one, rounded alike."""
        match = STATED.fullmatch(stated)
        assert match is not None, stated
        percent, *bounds = match.groups()
        decimals = max(len(bound.partition(".")[2]) for bound in bounds)
        lower, upper = map(float, bounds)
        ends = [round(100 * end if percent else end, decimals) for end in self[1:]]
        return ends[0] <= upper and lower <= ends[1]


def read() -> dict[str, dict]:
    """Returns the rows by name."""
    return yaml.safe_load(FILE.read_text(encoding="utf-8"))["rows"]


def results(row: dict) -> Iterator[tuple[str, str, str, str]]:
    """Yields (words of the evaluation, page, metric, value and interval) of a row's results."""
    for result in row["results"]:
        for metric, text in result["states"].items():
            if "|" in text:  # two cells of a table
                text = f"{text.replace('| ', '(')})"
            yield result.get("evaluate", ""), result["page"], metric, text


def run(row: str | None = None) -> int:
    """Lists the rows, or reproduces one. Returns the exit code: 1 if a result differs."""
    rows = read()
    if row is not None and row not in rows:
        raise UserError(f"{row!r} is unknown; {closest(row, rows)}")
    if row is not None:
        return reproduce(row, rows[row])
    for device, title in ("cpu", "On two CPU cores"), ("cuda", "On one H200"):
        lines = []
        for name, one in rows.items():
            if one["device"] == device:
                text = "; ".join(f"{metric} {text}" for *_, metric, text in results(one))
                lines.append([name, str(one.get("minutes", "")), one["train"], text])
        table = console.table(["row", "minutes", "megastep train", "result"], lines)
        console.say(f"{title}\n{table}")
    console.say(f"To run one: {package.command('reproduce', 'python ')} ROW")
    return 0


def reproduce(name: str, row: dict) -> int:
    """Trains and evaluates a row, and compares. Returns the exit code."""
    from megastep.agents.cli import evaluate, train
    from megastep.agents.launch import gpu

    if row["device"] == "cpu":
        os.environ["OMP_NUM_THREADS"] = str(CPU_THREADS)  # before PyTorch is imported
    elif not gpu.is_available():
        raise UserError(
            f"{name} needs a GPU, and PyTorch finds none here; choose a row for two CPU cores"
        )
    folder = folders.RUNS / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}-reproduce-{name}"
    device, finish = f"device={row['device']}", ("finish.evaluate=false", "finish.record=false")
    if code := train.main([*row["train"].split(), *finish, device, f"folder={folder}"]):
        return code
    found = []
    for more, group in itertools.groupby(results(row), lambda result: result[0]):
        if code := evaluate.main([f"run={folder}", device, "baseline=false", *more.split()]):
            return code
        tables = (folder / "evaluations").glob("*.json")
        newest = max(tables, key=lambda path: path.stat().st_mtime_ns)
        rows = json.loads(newest.read_bytes())["rows"]
        found += [found_in(rows, metric) for *_, metric, _ in group]
    return compare(name, row, folder, found)


def found_in(rows: list[dict], metric: str) -> Interval:
    """Returns a number of an evaluation's table: a mean, or the fraction of duels won."""
    cells, key = rows[0], metric
    if "against" in rows[0]:
        cells, key = next(row for row in rows if row["against"] == metric), "won"
    elif metric != "return":
        cells, key = rows[0]["metrics"][metric], "mean"
    return Interval(cells[key], cells["lower"], cells["upper"])


def compare(name: str, row: dict, folder: Path, found: list[Interval]) -> int:
    """Prints how numbers compare, and writes reproduction.json. Returns the exit code."""
    samples = json_lines.read(folder / "metrics.jsonl")[-1]["samples"]
    agree, values = True, {}
    for (_, page, metric, text), number in zip(results(row), found, strict=True):
        agrees = number.agrees(text)
        agree, values[f"{metric} {text}"] = agree and agrees, number.value
        verdict = "agrees" if agrees else "DIFFERS"
        console.say(f"{verdict}: {number}, stated {metric} {text}, docs/lab/{page}")
    if not agree and "samples=" not in row["train"]:
        busy = "in the same seconds a slower or busier machine has fewer"
        console.say(f"The run had {samples:,} samples; {busy}")
    console.say(f"{name} is {'' if agree else 'NOT '}reproduced: {folder}")
    report = dict(row=name, is_reproduced=agree, samples=samples, values=values)
    folders.write({folder / "reproduction.json": json.dumps(report, indent=2)})
    return 0 if agree else 1


COMMAND = Command("reproduce", run, HELP)
main = COMMAND.main
