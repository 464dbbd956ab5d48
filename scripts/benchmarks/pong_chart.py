"""What a step of Pong costs one environment, by how many are stepped at once: in plain Python, in
NumPy, by the engine, and in the Atari emulator; all with pictures.

    python scripts/benchmarks/pong_chart.py measure       # on the CPU; writes docs/lab/pong.jsonl
    python scripts/benchmarks/pong_chart.py draw          # docs/lab/pong.svg

One thread of the CPU each; on a GPU, the records of `python scripts/benchmarks/benchmark.py pong`.
Atari Pong is measured if ale-py is installed (pip install ale-py). It is under the GPL 2.0, so
nothing here requires it. Its frame has other rules and 160 x 210 pixels.
"""

import argparse
import json
import os
import re
import sys
import time
from datetime import date
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import torch

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "scripts" / "benchmarks")]

from benchmark import commit, machine  # noqa: E402
from benchmark_report import newest, read  # noqa: E402
from timing import TURNS, timed  # noqa: E402

from megastep import arrdict, envs  # noqa: E402
from tests.helpers.pong_twins import NumpyPong, PythonPong  # noqa: E402

LAB = ROOT / "docs" / "lab"
RECORDS, CHART = LAB / "pong.jsonl", LAB / "pong.svg"
BENCHMARKS = LAB / "benchmarks.jsonl"
ON_GPU = r"pong, pictures, `env.step`, ([\d,]+) environments"
STEPS = 300  # before it is timed, so that games are in all their phases
COLOURS = {
    "Atari emulator": "tab:red",
    "plain Python": "tab:orange",
    "NumPy": "tab:blue",
    "megastep": "tab:green",
}


def plain_python(n):
    games, random = [PythonPong(lane) for lane in range(n)], np.random.default_rng(1)
    actions = random.integers(3, size=(TURNS, n)).tolist()
    turn = turns()
    for game in games:
        game.reset()

    def step():
        for game, action in zip(games, actions[next(turn)]):
            game.step([action])

    return step


def numpy(n):
    games, turn = NumpyPong(n), turns()
    actions = np.random.default_rng(1).integers(3, size=(TURNS, 1, n))
    games.reset()
    return lambda: games.step(actions[next(turn)])


def megastep(n):
    env, turn = envs.Pong(n, pixels=True, device="cpu"), turns()
    actions = torch.randint(3, (TURNS, n, 1))
    decisions = [arrdict.arrdict(actions=some) for some in actions]
    env.reset()
    return lambda: env.step(decisions[next(turn)])


def atari(n):
    """A frame of each of ``n`` emulators, in grey. ImportError where ale-py is not installed."""
    from ale_py import ALEInterface, LoggerMode, roms

    ALEInterface.setLoggerMode(LoggerMode.Error)
    emulators = [ALEInterface() for _ in range(n)]
    for emulator in emulators:
        emulator.loadROM(roms.get_rom_path("pong"))
    legal, turn = emulators[0].getMinimalActionSet(), turns()
    actions = np.random.default_rng(1).integers(len(legal), size=(TURNS, n)).tolist()
    screens = np.empty((n, *emulators[0].getScreenDims()), np.uint8)

    def step():
        for emulator, action, screen in zip(emulators, actions[next(turn)], screens):
            emulator.act(legal[action])
            emulator.getScreenGrayscale(screen)
            if emulator.game_over():
                emulator.reset_game()

    return step


def turns():
    while True:
        yield from range(TURNS)


#: What is measured, and how many environments at most.
SUBJECTS = {
    "Atari emulator": (atari, 30),
    "plain Python": (plain_python, 1000),
    "NumPy": (numpy, 100_000),
    "megastep": (megastep, 100_000),
}


def sizes(most):
    """1, 3, 10, 30 ... to ``most``, which is the last."""
    found = [times * 10**power for power in range(7) for times in (1, 3)]
    return [n for n in found if n < most] + [most]


def measure(name):
    """A record per number of environments: seconds per step and environment, the least of some
    samples of 50 ms each, for whatever else the machine does only adds to them.
    """
    (make, most), device = SUBJECTS[name], torch.device("cpu")
    for n in sizes(most):
        step = make(n)
        start, steps = time.perf_counter(), 0
        while steps < STEPS and time.perf_counter() - start < 1:
            step()
            steps += 1
        yield dict(
            name=name,
            environments=n,
            seconds=float(f"{min(timed(step, device)) / n:.4g}"),
            **machine(device),
            commit=commit(),
            date=str(date.today()),
        )


def store(path, record):
    """Adds a record to the file of JSON lines, in the place of an older one of the same thing."""

    def key(one):
        return one["name"], one["environments"]

    lines = path.read_text().splitlines() if path.exists() else []
    records = {key(one): one for one in [*map(json.loads, lines), record]}
    lines = [json.dumps(records[k]) for k in sorted(records)]
    path.write_text("\n".join(lines) + "\n")


def on_gpu(records):
    """The same of the newest records of `benchmark.py pong`: (environments, seconds, GPU), ...."""
    for record in newest(records):
        match = re.fullmatch(ON_GPU, record["what"])
        if match and not record["on"].startswith("CPU"):
            yield int(match[1].replace(",", "")), 1e-6 / record["value"], record["on"]


def draw(records, benchmarks, path):
    """Seconds per step and environment against environments, both logarithmic."""
    import matplotlib
    from matplotlib.figure import Figure

    ax = Figure(figsize=(7.5, 4.8), layout="constrained").subplots()
    lines = {name: [r for r in records if r["name"] == name] for name in COLOURS}
    for name, own in lines.items():
        if own:
            n, seconds = zip(*sorted((r["environments"], r["seconds"]) for r in own))
            style = dict(color=COLOURS[name], marker="o", markersize=4)
            ax.plot(n, seconds, label=f"{name}, one CPU thread", **style)
    if points := sorted(on_gpu(benchmarks)):
        n, seconds, where = zip(*points)
        style = dict(color=COLOURS["megastep"], linestyle="--", marker="o", markersize=4)
        ax.plot(n, seconds, label=f"megastep, one {where[0]}", **style)
    ax.set(xscale="log", yscale="log", xlabel="environments")
    ax.set_ylabel("seconds per step and environment")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "megastep"}):
        ax.figure.savefig(path, metadata={"Date": None})


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("measure", "draw"))
    parser.add_argument("--only", nargs="+", choices=SUBJECTS, default=[*SUBJECTS])
    parser.add_argument("--records", type=Path, default=RECORDS)
    parser.add_argument("--chart", type=Path, default=CHART)
    options = parser.parse_args(argv)
    if options.what == "draw":
        draw(read(options.records), read(BENCHMARKS), options.chart)
        return
    torch.set_num_threads(1)
    for name in options.only:
        try:
            for record in measure(name):
                store(options.records, record)
                print(f"{name}, {record['environments']:,}: {record['seconds'] * 1e9:,.1f} ns")
        except ImportError as error:
            print(f"{name} is left out ({error}): pip install ale-py")


if __name__ == "__main__":
    main()
