"""Benchmarks of what happens once per process: `compile`, `first`, `startup`."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import torch
from paths import ROOT
from timing import measurement

N_PROCESSES = 3  # samples of what takes a process each
CUDA_CONTEXT = """
import time, torch
device = torch.device('{device}')
if device.type == 'cuda': torch.zeros(1, device=device)
"""
COMPILE_KERNELS = (
    CUDA_CONTEXT
    + """
from megastep.kernels.build import compile, launch
start = time.perf_counter()
engine = launch.ENGINE
compile.cuda(engine, device.index or 0) if device.type == 'cuda' else compile.cpu(engine)
print(time.perf_counter() - start)
"""
)
FIRST_STEP = (
    CUDA_CONTEXT
    + """
from megastep import arrdict, envs, toys
start = time.perf_counter()
env = envs.Explorer(64, [toys.box()], device=device)
env.reset()
actions = torch.zeros((64, 1), dtype=torch.long, device=device)
env.step(arrdict.arrdict(actions=actions)).reward.tolist()
print(time.perf_counter() - start)
"""
)


def printed_seconds(code: str, device: torch.device, n: int) -> list[float]:
    """Returns the seconds that ``code`` prints in each of ``n`` new processes, one after another.

    They share a cache that is empty at first, and so is the driver's, which keeps NVRTC's results.
    """
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"MEGASTEP_CACHE": cache, "CUDA_CACHE_PATH": cache}
        command = [sys.executable, "-c", code.format(device=device)]
        return [
            float(subprocess.check_output(command, text=True, cwd=ROOT, env=environment))
            for _ in range(n)
        ]


def compile_kernels(device: torch.device) -> Iterator[dict]:
    """Compilation of all kernels with an empty cache: by NVRTC for a GPU, by a C++ compiler for the
    CPU.
    """
    seconds = [printed_seconds(COMPILE_KERNELS, device, 1)[0] for _ in range(N_PROCESSES)]
    yield measurement("build of all kernels, cold cache", "s", seconds)


def first_step(device: torch.device) -> Iterator[dict]:
    """From imports, and a CUDA context, to the first step of 64 environments, with an empty cache
    and again with a full one.
    """
    pairs = [printed_seconds(FIRST_STEP, device, 2) for _ in range(N_PROCESSES)]
    for cache, seconds in zip(("cold", "warm"), zip(*pairs)):
        yield measurement(f"first `env.step` after import, {cache} cache", "s", seconds)


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
