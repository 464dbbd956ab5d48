"""The benchmark `startup`: how soon a command trains."""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import torch
from paths import ROOT
from timing import measurement

N_PROCESSES = 3  # samples of what takes a process each


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
