"""Runs train.py and evaluate.py for the benchmarks, and turns their results into measurements."""

import contextlib
import csv
import itertools
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from paths import ROOT
from timing import measurement

MAX_CURVE_POINTS = 50

#: (seconds of training, samples, metric)
CurvePoint = tuple[float, int, float]


@contextlib.contextmanager
def trained(device: torch.device, *runs: tuple[str, ...]) -> Iterator[list[Path]]:
    """Trains one run per tuple of overrides, all at the same time, on one device unless overrides
    name another.

    Gives the run folders, which are deleted at the end of the context. CalledProcessError if a run
    fails.
    """
    with tempfile.TemporaryDirectory() as parent:
        folders = [Path(parent) / f"run{i}" for i in range(len(runs))]
        commands = [
            [sys.executable, "train.py", *_with_device(overrides, device), f"folder={folder}"]
            for overrides, folder in zip(runs, folders)
        ]
        # stdout is for the table of measurements
        processes = [subprocess.Popen(command, cwd=ROOT, stdout=sys.stderr) for command in commands]
        try:
            for process, command in zip(processes, commands):
                if process.wait():
                    raise subprocess.CalledProcessError(process.returncode, command)
        finally:
            for process in processes:
                process.terminate()
                process.wait()
        yield folders


def _with_device(overrides, device):
    named = any(word.startswith("device=") for word in overrides)
    return overrides if named else (*overrides, f"device={device}")


def rates(run: Path) -> list[float]:
    """Returns the samples per second between each two reports of a run."""
    rows = map(json.loads, (run / "perf.jsonl").read_text().splitlines())
    return [row["perf/rate"] for row in rows if "perf/rate" in row]


def evaluate(run: Path, device: torch.device, *overrides: str) -> list[dict]:
    """Runs evaluate.py on a run folder. Returns the rows of its table."""
    command = [sys.executable, "evaluate.py", f"run={run}", f"device={device}", *overrides]
    subprocess.run(command, cwd=ROOT, stdout=sys.stderr, check=True)
    return newest_evaluation(run)


def evaluate_all(
    runs: Sequence[Path], devices: Sequence[torch.device], *overrides: Sequence[str]
) -> list[list[dict]]:
    """Evaluates runs at the same time, each on its device and with its overrides. Returns the rows
    of each table.
    """
    with ThreadPoolExecutor(len(runs)) as pool:
        return [
            *pool.map(
                lambda run, device, words: evaluate(run, device, *words), runs, devices, overrides
            )
        ]


def newest_evaluation(run: Path) -> list[dict]:
    """Returns the rows of the newest table in a run folder."""
    tables = (run / "evaluations").glob("*.json")
    newest = max(tables, key=lambda path: path.stat().st_mtime_ns)
    return json.loads(newest.read_text())["rows"]


def ratings(run: Path, device: torch.device, n_duels: int) -> list[dict[str, str]]:
    """Rates the run's snapshots and the scripted bot. Returns the rows of ratings.csv."""
    overrides = "ratings=true", "against=[bot]", f"episodes={n_duels}"
    command = [sys.executable, "evaluate.py", f"run={run}", f"device={device}", *overrides]
    subprocess.run(command, cwd=ROOT, stdout=sys.stderr, check=True)
    return list(csv.DictReader((run / "ratings.csv").read_text().splitlines()))


def reports(run: Path) -> list[dict]:
    """Returns the reports of training, each with those of `perf.jsonl` at the same samples."""
    metrics, perf = (
        {row["samples"]: row for row in map(json.loads, (run / name).read_text().splitlines())}
        for name in ("metrics.jsonl", "perf.jsonl")
    )
    return [row | perf[samples] for samples, row in metrics.items() if samples in perf]


def learning_curve(run: Path, metric: str = "return") -> list[CurvePoint]:
    """Returns a metric of the episodes that ended during training, a point per logged update."""
    return [
        (row["perf/seconds"], row["samples"], row[f"episode/{metric}"])
        for row in reports(run)
        if f"episode/{metric}" in row
    ]


# ---- Measurements ----


def training_rate(what: str, curve: list[CurvePoint]) -> dict:
    """Measures samples per second between the points of a curve. Contains the curve, thinned out.

    ``curve`` has at least two points.
    """
    rates = [
        (samples - samples_before) / (seconds - seconds_before) / 1e6
        for (seconds_before, samples_before, _), (seconds, samples, _) in itertools.pairwise(curve)
    ]
    return measurement(f"{what}, median rate", "M/s", rates) | dict(curve=thinned(curve, 3))


def thinned(curve: list[CurvePoint], digits: int) -> list[list[float]]:
    """Returns at most MAX_CURVE_POINTS points of a curve, with so many digits of the metric."""
    stride = -(-len(curve) // MAX_CURVE_POINTS)
    return [[round(s, 2), n, round(value, digits)] for s, n, value in curve[::stride]]


def metric_mean(what: str, row: dict, metric: str) -> dict:
    """Measures the return, or a metric by name, of a row of an evaluation.

    ``lower`` and ``upper`` are its 95 % interval over homes, or over episodes if there are none.
    """
    interval = row if metric == "return" else row["metrics"][metric]
    value = row["return"] if metric == "return" else interval["mean"]
    return _mean(what, value, interval, row["homes"] or row["lanes"])


def share_of_duels_won(what: str, row: dict) -> dict:
    """Measures the share of duels won, a draw being half, of a row of duels."""
    counts = f"{row['wins']} won, {row['draws']} drawn, {row['losses']} lost"
    what = f"{what}: duels against {row['against'].rpartition(':')[2]} ({counts})"
    return _mean(what, row["won"], row, row["homes"] or row["duels"])


def _mean(what, value, interval, n):
    bounds = {key: interval[key] for key in ("lower", "upper")}
    return dict(what=what, value=value, unit="", **bounds, n=n)


def rating(what: str, row: dict[str, str]) -> dict:
    """Measures the rating of a row of :func:`ratings`, plus and minus two standard deviations."""
    value, spread = float(row["rating"]), 2 * float(row["sigma"])
    return dict(
        what=f"{what}, rating of {row['player'].rpartition(':')[2]}",
        value=value,
        unit="",
        lower=value - spread,
        upper=value + spread,
        n=int(row["duels"]),
    )
