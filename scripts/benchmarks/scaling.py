"""The benchmark `scaling`: training on several GPUs."""

import statistics
import subprocess
import sys
from collections.abc import Iterator

import torch
from records import ROOT
from timing import measurement
from training import rates, trained

N_ROUNDS = 2
#: Per GPU, enough for several reports: 3 to 5 s.
SAMPLES = {"cuda": 60_000_000, "cpu": 100_000}
NAMES = "explorer", "pointgoal", "experiment=memory_9"


def scaling(device: torch.device, envs: list[str] | None = None) -> Iterator[dict]:
    """Samples per second of training with default settings per GPU, on one GPU and on 2, 4 and 8 as
    far as there are, in turn, twice each; and the time of an all-reduce of the gradients.
    """
    for name in map(str.lower, envs or NAMES):
        env = name.rpartition("=")[2]
        by_count = {n: [] for n in _counts(device)}
        for _ in range(N_ROUNDS):
            for n, found in by_count.items():
                samples = n * SAMPLES[device.type]
                words = [name if "=" in name else f"env={name}", f"ranks={n}", f"samples={samples}"]
                words += [f"device={device.type}", "finish.evaluate=false", "finish.record=false"]
                with trained(device, (*words,)) as (run,):
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


def _counts(device):
    """Returns the numbers of ranks to compare."""
    n_devices = torch.cuda.device_count() if device.type == "cuda" else 2
    return [n for n in (1, 2, 4, 8) if n <= n_devices]


def _devices(n, device):
    one, several = ("GPU", "GPUs") if device.type == "cuda" else ("process", "processes")
    return f"{n} {several if n > 1 else one}"
