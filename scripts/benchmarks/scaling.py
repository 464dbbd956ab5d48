"""Benchmarks of training on several GPUs: `scaling`, `ranks`."""

import statistics
import subprocess
import sys
from collections.abc import Iterator

import torch
from paths import ROOT
from timing import measurement
from training import learning_curve, rates, trained

N_ROUNDS = 3
#: What trains long enough for a steady rate; about 8 s on a GPU.
SAMPLES = {"cuda": 150_000_000, "cpu": 100_000}
#: Samples of the comparison at equal samples.
EQUAL_SAMPLES = {"cuda": 100_000_000, "cpu": 200_000}
#: Environments of one GPU, or of all GPUs together.
N_ENVS = {"cuda": 4096, "cpu": 64}


def scaling(device: torch.device, envs: list[str] | None = None) -> Iterator[dict]:
    """Samples per second of training with default settings per GPU, on one GPU and on 2, 4 and 8 as
    far as there are, in turn, three times each; and the time of an all-reduce of the gradients.
    """
    for env in map(str.lower, envs or ("Explorer", "PointGoal")):
        by_count = {n: [] for n in _counts(device)}
        for _ in range(N_ROUNDS):
            for n, found in by_count.items():
                samples = n * SAMPLES[device.type]
                words = f"env={env}", f"ranks={n}", f"samples={samples}", f"device={device.type}"
                with trained(device, words) as (run,):
                    found.append(statistics.median(rates(run)) / 1e6)
        one = statistics.median(by_count[1])
        for n, found in by_count.items():
            yield measurement(f"{env}, training on {_devices(n, device)}", "M/s", found)
            if n > 1:
                shares = [100 * rate / (n * one) for rate in found]
                yield measurement(f"{env}, {_devices(n, device)}: of linear", "%", shares)
    for n in _counts(device):
        if n > 1:
            command = [sys.executable, "-m", "torch.distributed.run", f"--nproc-per-node={n}"]
            command += [ROOT / "scripts" / "benchmarks" / "all_reduce.py", device.type]
            printed = subprocess.check_output(command, text=True, cwd=ROOT)
            for line in printed.splitlines():
                n_floats, *microseconds = line.split()
                what = f"all-reduce of {int(n_floats):,} float32 over {_devices(n, device)}"
                yield measurement(what, "us", [*map(float, microseconds)])


def ranks(
    device: torch.device, seeds: list[int] | None = None, budgets: list[int] | None = None
) -> Iterator[dict]:
    """Explorer's return in training, of one GPU and of all: after 10, 30 and 60 s (`--budgets`) of
    one run with as many environments on each GPU, and after equal samples with as many environments
    in all. A sample per seed.
    """
    *_, n = _counts(device)
    seeds, n_envs, budgets = (
        seeds or (1, 2, 3),
        N_ENVS[device.type],
        sorted(budgets or (10, 30, 60)),
    )
    for count in (1, n):
        words = f"seconds={budgets[-1]}", f"env.n_envs={n_envs}"
        curves = _curves(device, count, seeds, *words)
        for seconds in budgets:
            yield measurement(
                f"explorer, {seconds} s on {_devices(count, device)}: return in training",
                "",
                [[value for at, _, value in curve if at <= seconds][-1] for curve in curves],
            )
    samples = EQUAL_SAMPLES[device.type]
    for count in (1, n):
        words = f"samples={samples}", f"env.n_envs={n_envs // count}"
        what = f"explorer, {samples / 1e6:g} M samples, {n_envs:,} environments in all"
        found = [curve[-1][-1] for curve in _curves(device, count, seeds, *words)]
        yield measurement(f"{what}, on {_devices(count, device)}: return in training", "", found)


def _curves(device, n_ranks, seeds, *words):
    """Returns the learning curve of a run per seed. Runs on one GPU share the GPUs."""
    words = "env=explorer", "logging.every=5", *words
    if n_ranks > 1 or device.type == "cpu":
        words += f"ranks={n_ranks}", f"device={device.type}"
        batches = [[(*words, f"seed={seed}")] for seed in seeds]
    else:
        n = torch.cuda.device_count()
        runs = [(*words, f"seed={seed}", f"device=cuda:{i % n}") for i, seed in enumerate(seeds)]
        batches = [runs[i : i + n] for i in range(0, len(runs), n)]
    curves = []
    for batch in batches:
        with trained(device, *batch) as folders:
            curves += [learning_curve(folder) for folder in folders]
    return curves


def _counts(device):
    """Returns the numbers of ranks to compare."""
    n_devices = torch.cuda.device_count() if device.type == "cuda" else 2
    return [n for n in (1, 2, 4, 8) if n <= n_devices]


def _devices(n, device):
    one, several = ("GPU", "GPUs") if device.type == "cuda" else ("process", "processes")
    return f"{n} {several if n > 1 else one}"
