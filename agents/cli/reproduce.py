"""Makes results of docs/lab again, with `megastep train` and `megastep evaluate`."""

import itertools
import json
import os
import re
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml

from megastep.agents import console, package
from megastep.agents.cli.command import Command
from megastep.agents.errors import UserError, user_errors
from megastep.agents.runs import json_lines
from megastep.atomic_files import write_atomically
from megastep.settings import closest, frozen

HELP = """Makes results of docs/lab again.

  megastep reproduce          lists them
  megastep reproduce ROW      trains and evaluates one, and compares"""
#: The rows; its head says what they consist of.
FILE = Path(__file__).with_name("reproductions.yaml")
#: Threads of rows for a CPU: as many as the stated results were made with.
CPU_THREADS = 2
#: `value (lower to upper)`, or two cells of a table: `value | lower to upper`. In percent or not.
STATED = re.compile(r"(-?[\d.]+)( %)? (?:\(|\| )(-?[\d.]+) to (-?[\d.]+)\)?")


class Interval(NamedTuple):
    """A value and its 95 % interval."""

    value: float
    lower: float
    upper: float

    def __str__(self) -> str:
        return f"{self.value:.4g} ({self.lower:.4g} to {self.upper:.4g})"


class Result(NamedTuple):
    """A number that a page states.

    Attributes:
        page: of docs/lab. One of its lines contains both `line` and `text`.
        evaluate: words of `megastep evaluate`.
        metric: of the evaluation's table; in duels, the opponent.
        text: value and 95 % interval as the page writes them.
    """

    page: str
    line: str
    evaluate: str
    metric: str
    text: str

    def __str__(self) -> str:
        value, percent, lower, upper = self._parts()
        return f"{self.metric} {value}{percent} ({lower} to {upper})"

    def agrees(self, found: Interval) -> bool:
        """Returns true if a 95 % interval, rounded as the stated one is, has a number in common
        with it.
        """
        _, percent, *bounds = self._parts()
        decimals = max(len(bound.partition(".")[2]) for bound in bounds)
        lower, upper = map(float, bounds)
        _, *ends = (round(100 * end if percent else end, decimals) for end in found)
        return ends[0] <= upper and lower <= ends[1]

    def _parts(self) -> Sequence[str]:
        match = STATED.fullmatch(self.text)
        assert match is not None
        return match.groups(default="")


class Row(NamedTuple):
    """A training run with its results.

    Attributes:
        device: cpu or cuda.
        train: words of `megastep train`.
        minutes: of the run and its evaluations, about; given for a CPU.
    """

    name: str
    device: str
    train: str
    results: list[Result]
    minutes: int | None = None


def read() -> dict[str, Row]:
    """Returns the rows by name."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times as fast, where it is built
    rows = yaml.load(FILE.read_text(encoding="utf-8"), loader)["rows"]
    return {name: Row(name, **{**row, "results": [*_results(row)]}) for name, row in rows.items()}


def _results(row: dict) -> Iterator[Result]:
    for result in row["results"]:
        for metric, text in result["states"].items():
            yield Result(result["page"], result["line"], result.get("evaluate", ""), metric, text)


@frozen
class Reproduce:
    row: str | None = None


def run(cfg: Reproduce) -> int:
    """Lists the rows, or reproduces one. Returns the exit code: 1 if a result differs."""
    rows = read()
    if cfg.row is None:
        for device, title in ("cpu", "On two CPU cores"), ("cuda", "On one H200"):
            lines = [
                [row.name, str(row.minutes or ""), row.train, "; ".join(map(str, row.results))]
                for row in rows.values()
                if row.device == device
            ]
            table = console.table(["row", "minutes", "megastep train", "result"], lines)
            console.say(f"{title}\n{table}")
        console.say(f"To run one: {package.command('reproduce', 'python ')} ROW")
        return 0
    if cfg.row not in rows:
        raise UserError(f"{cfg.row!r} is unknown; {closest(cfg.row, rows)}")
    return reproduce(rows[cfg.row])


def reproduce(row: Row) -> int:
    """Trains and evaluates a row, and compares. Returns the exit code."""
    from megastep.agents.cli import evaluate, train
    from megastep.agents.launch import gpu
    from megastep.agents.runs import folders

    if row.device == "cpu":
        os.environ["OMP_NUM_THREADS"] = str(CPU_THREADS)  # before PyTorch is imported
    elif not gpu.is_available():
        raise UserError(
            f"{row.name} needs a GPU, and PyTorch finds none here; choose a row for two CPU cores"
        )
    folder = folders.RUNS / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}-reproduce-{row.name}"
    device = f"device={row.device}"
    finish = "finish.evaluate=false", "finish.record=false"
    if code := train.main([*row.train.split(), *finish, device, f"folder={folder}"]):
        return code
    found = []
    for more, group in itertools.groupby(row.results, lambda result: result.evaluate):
        if code := evaluate.main([f"run={folder}", device, "baseline=false", *more.split()]):
            return code
        tables = (folder / "evaluations").glob("*.json")
        newest = max(tables, key=lambda path: path.stat().st_mtime_ns)
        rows = json.loads(newest.read_bytes())["rows"]
        found += [found_in(rows, result.metric) for result in group]
    return compare(row, folder, found)


def found_in(rows: list[dict], metric: str) -> Interval:
    """Returns a number of an evaluation's table: a mean, or the fraction of duels won."""
    cells, key = rows[0], metric
    if "against" in rows[0]:
        cells, key = next(row for row in rows if row["against"] == metric), "won"
    elif metric != "return":
        cells, key = rows[0]["metrics"][metric], "mean"
    return Interval(cells[key], cells["lower"], cells["upper"])


def compare(row: Row, folder: Path, found: Sequence[Interval]) -> int:
    """Prints how numbers compare with those stated, and writes reproduction.json. Returns the exit
    code.
    """
    samples = json_lines.read(folder / "metrics.jsonl")[-1]["samples"]
    agree = [*map(Result.agrees, row.results, found)]
    for result, number, agrees in zip(row.results, found, agree, strict=True):
        verdict = "agrees" if agrees else "DIFFERS"
        console.say(f"{verdict}: {number}, stated {result}, docs/lab/{result.page}")
    if not all(agree) and "samples=" not in row.train:
        busy = "in the same seconds a slower or busier machine has fewer"
        console.say(f"The run had {samples:,} samples; {busy}")
    console.say(f"{row.name} is {'' if all(agree) else 'NOT '}reproduced: {folder}")
    values = {str(result): number.value for result, number in zip(row.results, found)}
    report = dict(row=row.name, is_reproduced=all(agree), samples=samples, values=values)
    with user_errors(f"{folder} cannot be written: "):
        write_atomically(folder / "reproduction.json", json.dumps(report, indent=2).encode())
    return 0 if all(agree) else 1


COMMAND = Command("reproduce", Reproduce, HELP)
main = COMMAND.main
