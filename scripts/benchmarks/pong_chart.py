"""Compares what a step of Pong with images costs per environment, over the number of environments.

    python scripts/benchmarks/pong_chart.py measure       # on the CPU; writes docs/lab/pong.jsonl
    python scripts/benchmarks/pong_chart.py draw          # docs/lab/pong.svg

Compared are plain Python, NumPy, megastep and the Atari emulator on one CPU thread each, and
megastep on a GPU, from the records of `python scripts/benchmarks/benchmark.py pong`. Atari Pong is
measured if ale-py is installed (pip install ale-py). It is under the GPL 2.0, so nothing here
requires it. It has other rules and frames of 160 x 210 pixels.
"""

import argparse
import itertools
import json
import os
import re
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # idle threads of PyTorch must not spin
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # this checkout comes first

import figures
import numpy as np
import paths
import records
import torch
from timing import N_CALLS, seconds_per_call

from megastep import arrdict, envs
from tests.helpers.pong_twins import NumpyPong, PythonPong

GPU_MEASUREMENT = r"pong, pictures, `env.step`, ([\d,]+) environments"
N_WARM_UP = 300  # steps before timing, so that games are in all phases
MAX_WARM_UP_SECONDS = 1
COLOURS = {
    "Atari emulator": "tab:red",
    "plain Python": "tab:orange",
    "NumPy": "tab:blue",
    "megastep": "tab:green",
}

# ---- Implementations: each returns a function that steps n environments ----


def plain_python(n: int) -> Callable[[], None]:
    games, generator = [PythonPong(lane) for lane in range(n)], np.random.default_rng(1)
    actions = itertools.cycle(generator.integers(3, size=(N_CALLS, n)).tolist())
    for game in games:
        game.reset()

    def step():
        for game, action in zip(games, next(actions)):
            game.step([action])

    return step


def numpy(n: int) -> Callable[[], object]:
    games = NumpyPong(n)
    actions = itertools.cycle(np.random.default_rng(1).integers(3, size=(N_CALLS, 1, n)))
    games.reset()
    return lambda: games.step(next(actions))


def megastep(n: int) -> Callable[[], object]:
    env = envs.Pong(n, pixels=True, device="cpu")
    actions = torch.randint(3, (N_CALLS, n, 1))
    decisions = itertools.cycle([arrdict.arrdict(actions=row) for row in actions])
    env.reset()
    return lambda: env.step(next(decisions))


def atari(n: int) -> Callable[[], None]:
    """Steps ``n`` emulators and reads their grey images. ImportError without ale-py."""
    from ale_py import ALEInterface, LoggerMode, roms

    ALEInterface.setLoggerMode(LoggerMode.Error)
    emulators = [ALEInterface() for _ in range(n)]
    for emulator in emulators:
        emulator.loadROM(roms.get_rom_path("pong"))
    legal = emulators[0].getMinimalActionSet()
    indices = np.random.default_rng(1).integers(len(legal), size=(N_CALLS, n))
    actions = itertools.cycle(indices.tolist())
    screens = np.empty((n, *emulators[0].getScreenDims()), np.uint8)

    def step():
        for emulator, action, screen in zip(emulators, next(actions), screens):
            emulator.act(legal[action])
            emulator.getScreenGrayscale(screen)
            if emulator.game_over():
                emulator.reset_game()

    return step


#: Name: (implementation, largest number of environments).
IMPLEMENTATIONS = {
    "Atari emulator": (atari, 30),
    "plain Python": (plain_python, 1000),
    "NumPy": (numpy, 100_000),
    "megastep": (megastep, 100_000),
}


# ---- Measuring ----


def sizes(largest: int) -> list[int]:
    """Returns 1, 3, 10, 30, ... up to ``largest``, which is always the last."""
    candidates = [factor * 10**power for power in range(7) for factor in (1, 3)]
    return [n for n in candidates if n < largest] + [largest]


def measure(name: str) -> Iterator[dict]:
    """Yields a record per number of environments: seconds per step and environment.

    It is the minimum over samples of 50 ms, since other load on the machine only adds to them.
    """
    (implementation, largest), device = IMPLEMENTATIONS[name], torch.device("cpu")
    for n in sizes(largest):
        step = implementation(n)
        end = time.perf_counter() + MAX_WARM_UP_SECONDS
        for _ in range(N_WARM_UP):
            step()
            if time.perf_counter() > end:
                break
        seconds = float(f"{min(seconds_per_call(step, device)) / n:.4g}")
        provenance = records.provenance(device, records.commit())
        yield dict(name=name, environments=n, seconds=seconds) | provenance


def store(path: Path, record: dict) -> None:
    """Adds a record to a file of JSON lines, or replaces the one of the same name and size."""
    old_records = records.read(path) if path.exists() else []
    newest = {(row["name"], row["environments"]): row for row in [*old_records, record]}
    path.write_text("".join(json.dumps(newest[key]) + "\n" for key in sorted(newest)))


# ---- Drawing ----


def gpu_points(rows: list[dict]) -> Iterator[tuple[int, float, str]]:
    """Yields (environments, seconds per environment, GPU) from records of `benchmark.py pong`."""
    for record in records.newest(rows):
        match = re.fullmatch(GPU_MEASUREMENT, record["what"])
        if match and not figures.is_cpu(record):
            yield int(match[1].replace(",", "")), 1e-6 / record["value"], record["on"]


def draw(rows: list[dict], benchmark_rows: list[dict], path: Path) -> None:
    """Plots seconds per step and environment over the number of environments, both logarithmic."""
    ax = figures.subplots(7.5, 4.8)
    for name, colour in COLOURS.items():
        points = [(row["environments"], row["seconds"]) for row in rows if row["name"] == name]
        if points:
            style = dict(color=colour, marker="o", markersize=4)
            ax.plot(*zip(*sorted(points)), label=f"{name}, one CPU thread", **style)
    if points := sorted(gpu_points(benchmark_rows)):
        n_envs, seconds, gpus = zip(*points)
        style = dict(color=COLOURS["megastep"], linestyle="--", marker="o", markersize=4)
        ax.plot(n_envs, seconds, label=f"megastep, one {gpus[0]}", **style)
    ax.set(xscale="log", yscale="log", xlabel="environments")
    ax.set_ylabel("seconds per step and environment")
    figures.finish(ax, path)


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("measure", "draw"))
    parser.add_argument("--only", nargs="+", choices=IMPLEMENTATIONS, default=[*IMPLEMENTATIONS])
    parser.add_argument("--records", type=Path, default=paths.PONG_RECORDS)
    parser.add_argument("--chart", type=Path, default=paths.PONG_CHART)
    arguments = parser.parse_args(argv)
    if arguments.what == "draw":
        draw(records.read(arguments.records), records.read(paths.RECORDS), arguments.chart)
        return
    torch.set_num_threads(1)
    for name in arguments.only:
        try:
            for record in measure(name):
                store(arguments.records, record)
                nanoseconds = record["seconds"] * 1e9
                print(f"{name}, {record['environments']:,}: {nanoseconds:,.1f} ns")
        except ImportError as error:
            print(f"{name} is skipped ({error}): pip install ale-py")


if __name__ == "__main__":
    main()
