"""Benchmark of training: `published`, tasks of others beside what others publish for them.

A task is one run per recurrent core and seed. Several runs may train side by side; without a GPU
each has CPU cores of its own. A run folder that exists is measured and not trained again, so a
benchmark that was cut short reports what its runs had reached.

Options: `--tasks` are names in TASKS; `--jobs` is the number of runs side by side; a run ends after
`--seconds`, whatever its samples; `--folder` keeps the run folders.
"""

import dataclasses
import importlib.metadata
import json
import os
import queue
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import plain_evaluation
import torch
from paths import ROOT
from training_runs import evaluate, learning_curve, thinned

SEEDS = 1, 2, 3
EPISODES = 100  # of an evaluation
EVALUATION_SEED = 1000  # times the seed of training, so that runs share no episode


@dataclasses.dataclass(frozen=True)
class Task:
    """A task, its budget and what it has to reach.

    Args:
        overrides: of training.
        samples: per run.
        target: of the return. Of POPGym the largest that its paper has for LSTM or GRU; None: not
            known.
        cores: recurrent cores to compare.
        seeds: of training.
        is_peak: the measure is the largest mean return of a report during training, POPGym's
            (MMER), instead of the return of an evaluation afterwards.
        packages: whose versions are recorded.
    """

    overrides: str
    samples: int
    target: float | None
    cores: tuple[str, ...] = ("none",)
    seeds: tuple[int, ...] = SEEDS
    is_peak: bool = False
    packages: tuple[str, ...] = ("gymnasium",)


def _popgym(name, target=None):
    return Task(
        f"experiment=popgym env.id=popgym:popgym-{name}-v0",
        samples=15_000_000,
        target=target,
        cores=("lstm", "gru", "mingru", "none"),
        seeds=SEEDS[:1],
        is_peak=True,
        packages=("gymnasium", "popgym"),
    )


#: Title: task.
TASKS = {
    "CartPole-v1": Task("env=gymnasium env.id=CartPole-v1", 100_000, 475),
    "Acrobot-v1": Task("env=gymnasium env.id=Acrobot-v1", 150_000, -100),
    "Pendulum-v1": Task("env=gymnasium env.id=Pendulum-v1", 200_000, -200),
    "LunarLander-v3": Task("experiment=lunarlander", 500_000, 200, packages=("gymnasium", "box2d")),
    "LunarLander-v3, continuous": Task(
        "experiment=lunarlander env.kwargs.continuous=true agent.continuous=beta",
        500_000,
        200,
        packages=("gymnasium", "box2d"),
    ),
    "MiniGrid-DoorKey-6x6-v0": Task(
        "experiment=minigrid", 200_000, 0.9, seeds=SEEDS[:1], packages=("gymnasium", "minigrid")
    ),
    "popgym-RepeatPreviousEasy-v0": _popgym("RepeatPreviousEasy"),
    "popgym-CountRecallEasy-v0": _popgym("CountRecallEasy"),
    "popgym-AutoencodeEasy-v0": _popgym("AutoencodeEasy"),
}


@dataclasses.dataclass(frozen=True)
class Run:
    """One run of a task, in a folder."""

    title: str
    core: str
    seed: int
    folder: Path

    @property
    def task(self) -> Task:
        return TASKS[self.title]


def published(
    device: torch.device,
    tasks: Sequence[str] = tuple(TASKS),
    seeds: Sequence[int] | None = None,
    samples: int | None = None,
    seconds: int | None = None,
    jobs: int = 1,
    folder: Path | None = None,
) -> Iterator[dict]:
    """Tasks of Gymnasium, POPGym and MiniGrid beside published results: the mean over seeds of the
    return of 100 new episodes with the most likely actions, or in POPGym of the largest mean return
    of a report in training. The interval reaches from the lowest to the highest bound of the seeds'
    95 % intervals.
    """
    with tempfile.TemporaryDirectory() as parent:
        parent = Path(folder or parent).resolve()
        runs = [
            Run(title, core, seed, parent / f"{title.replace(', ', '-')}-{core}-{seed}")
            for title in tasks
            for core in TASKS[title].cores
            for seed in (seeds or TASKS[title].seeds)
        ]
        limits = [] if seconds is None else [f"seconds={seconds}", "learner.anneal=seconds"]
        with ThreadPoolExecutor(jobs) as pool:
            idle = queue.SimpleQueue()  # core sets that no run has
            for cores in core_sets(jobs):
                idle.put(cores)
            done = [
                pool.submit(_train_and_measure, run, device, samples, limits, idle) for run in runs
            ]
            by_run = dict(zip(runs, done))
            for title in tasks:
                for core in TASKS[title].cores:
                    chosen = {
                        run: future.result()
                        for run, future in by_run.items()
                        if (run.title, run.core) == (title, core)
                    }
                    if rows := {run: row for run, row in chosen.items() if row}:
                        yield summary(rows)


def core_sets(jobs: int) -> list[list[int]]:
    """Returns the CPU cores of each of `jobs` runs side by side, shared if there are too few."""
    cores = sorted(os.sched_getaffinity(0))
    share = max(1, len(cores) // jobs)
    return [[cores[(i * share + k) % len(cores)] for k in range(share)] for i in range(jobs)]


def _train_and_measure(run, device, samples, limits, idle):
    """Trains a run unless its folder exists. Returns its row, None if no episode ended."""
    if not run.folder.exists():
        words = (
            f"{run.task.overrides} agent.core={run.core} seed={run.seed} device={device} "
            f"samples={samples or run.task.samples} folder={run.folder}"
        )
        finish = "finish.evaluate=false", "finish.record=false"
        command = [sys.executable, "train.py", *words.split(), *limits, *finish]
        cores = idle.get()
        environment = {"OMP_NUM_THREADS": str(len(cores))} | os.environ
        process = subprocess.Popen(command, cwd=ROOT, stdout=sys.stderr, env=environment)
        if device.type == "cpu":  # a process with a GPU is helped by whatever core is idle
            os.sched_setaffinity(process.pid, cores)
        code = process.wait()
        idle.put(cores)
        if code and not run.task.is_peak:
            raise subprocess.CalledProcessError(code, command)
    return measured(run, device)


def measured(run: Run, device: torch.device) -> dict | None:
    """Returns seed, value, lower, upper, episodes, samples, seconds and curve of a trained run.

    A run that is evaluated takes its most likely actions. It also has `sampled`, the mean return of
    sampled actions, and `plain`, that of the independent evaluator, again of the most likely ones.
    """
    has_reports = (run.folder / "metrics.jsonl").exists()
    curve = learning_curve(run.folder) if has_reports else []
    if not curve:
        return None
    seconds, samples, _ = curve[-1]
    row = dict(seed=run.seed, samples=samples, seconds=round(seconds, 1))
    if run.task.is_peak:
        peak = max(curve, key=lambda point: point[2])
        row |= dict(value=peak[2], lower=peak[2], upper=peak[2], peak_samples=peak[1])
        row["episodes"] = _window(run.folder, peak[1])
    else:
        seed = EVALUATION_SEED * run.seed
        words = f"episodes={EPISODES}", f"seed={seed}", "baseline=false"
        row["sampled"] = evaluate(run.folder, device, *words)[0]["return"]
        evaluated = evaluate(run.folder, device, *words, "greedy=true")[0]
        row |= {key: evaluated[key] for key in ("lower", "upper")}
        row |= dict(value=evaluated["return"], episodes=evaluated["lanes"])
        returns = plain_evaluation.returns(run.folder, EPISODES, seed)
        row["plain"] = statistics.mean(returns)
    return row | dict(curve=thinned(curve, 4))


def _window(folder, samples):
    """Returns the number of episodes that a report's means are over."""
    rows = map(json.loads, (folder / "metrics.jsonl").read_text().splitlines())
    return next(int(row["episode/window"]) for row in rows if row["samples"] == samples)


def summary(rows: dict[Run, dict]) -> dict:
    """Returns the measurement of one task and core from its runs."""
    run = next(iter(rows))
    measure = "largest mean return in training" if run.task.is_peak else "return"
    seeds = list(rows.values())
    return dict(
        what=f"{run.title}, {run.core}: {measure}",
        value=statistics.mean(row["value"] for row in seeds),
        lower=min(row["lower"] for row in seeds),
        upper=max(row["upper"] for row in seeds),
        unit="",
        n=sum(row["episodes"] for row in seeds),
        target=run.task.target,
        versions={name: importlib.metadata.version(name) for name in run.task.packages},
        seeds=seeds,
    )
