"""The benchmarks `train` and `startup`, and training in processes of their own for others."""

import contextlib
import itertools
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from records import ROOT
from timing import measurement

BUDGETS, SEEDS = (3, 30), (1, 2, 3)
MAX_CURVE_POINTS = 50
N_PROCESSES = 3  # samples of what takes a process each
#: (seconds of training, samples, return)
CurvePoint = tuple[float, int, float]


def train(
    device: torch.device, seeds: Sequence[int] = SEEDS, budgets: Sequence[int] = BUDGETS
) -> Iterator[dict]:
    """Training of Explorer in the benchmark's homes for 3 and 30 seconds after compilation, three
    seeds each, and an evaluation in unseen homes.
    """
    for budget, seed in itertools.product(budgets, seeds):
        what = f"training, {budget} s, seed {seed}"
        words = "geometry=bench", "finish.evaluate=true", f"seconds={budget}", f"seed={seed}"
        with trained(device, words) as (run,):
            tables = (run / "evaluations").glob("*.json")
            (rows,) = (json.loads(path.read_text())["rows"] for path in tables)
            curve = learning_curve(run)
        for agent, row in zip(("return", "return of random actions"), rows):
            interval = dict(value=row["return"], lower=row["lower"], upper=row["upper"])
            yield dict(what=f"{what}, {agent} in unseen homes", unit="", n=row["homes"]) | interval
        if len(curve) > 1:
            yield training_rate(what, curve)


def startup(device: torch.device) -> Iterator[dict]:
    """From the command `python train.py geometry=bench` to the end of its first update, with warm
    caches.
    """
    seconds = []
    for _ in range(N_PROCESSES + 1):  # the first fills the caches
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "train.py", "geometry=bench", "samples=1", "logging.every=1"]
            command += [f"folder={folder}/run", f"device={device}"]
            start = time.perf_counter()
            with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
                next(line for line in process.stdout if " samples" in line)
                seconds.append(time.perf_counter() - start)
                process.communicate()
    yield measurement("command to first update, warm cache", "s", seconds[1:])


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
            [sys.executable, "train.py", f"device={device}", *overrides, f"folder={folder}"]
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


def rates(run: Path) -> list[float]:
    """Returns the samples per second between each two reports of a run."""
    rows = map(json.loads, (run / "perf.jsonl").read_text().splitlines())
    return [row["perf/rate"] for row in rows if "perf/rate" in row]


def learning_curve(run: Path) -> list[CurvePoint]:
    """Returns the return of the episodes that ended during training, a point per report."""
    metrics, perf = (
        {row["samples"]: row for row in map(json.loads, (run / name).read_text().splitlines())}
        for name in ("metrics.jsonl", "perf.jsonl")
    )
    return [
        (perf[samples]["perf/seconds"], samples, row["episode/return"])
        for samples, row in metrics.items()
        if samples in perf and "episode/return" in row
    ]


def training_rate(what: str, curve: list[CurvePoint]) -> dict:
    """Measures samples per second between the points of a curve, at least two. The measurement has
    the curve, thinned out.
    """
    found = [
        (samples - samples_before) / (seconds - seconds_before) / 1e6
        for (seconds_before, samples_before, _), (seconds, samples, _) in itertools.pairwise(curve)
    ]
    stride = -(-len(curve) // MAX_CURVE_POINTS)
    points = [[round(s, 2), n, round(value, 3)] for s, n, value in curve[::stride]]
    return measurement(f"{what}, median rate", "M/s", found) | dict(curve=points)
