"""Long use: a run that is interrupted, killed and resumed again and again, and environments that
are stepped for long.
"""

import functools
import itertools
import json
import os
import pathlib
import random
import signal
import subprocess
import sys
import time

import pytest
import torch

from megastep import engine, envs
from megastep.agents.cli import evaluate, train
from megastep.agents.training import checkpoint
from megastep.arrdict import arrdict
from megastep.dotdict import leaves
from megastep.geometries import sample
from megastep.modules.spawning import distances
from tests.helpers import tiny
from tests.helpers.processes import HUNG, wait_until

ROOT = pathlib.Path(__file__).parents[2]
SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL]

pytestmark = pytest.mark.nightly


def samples_in(folder):
    """Returns the samples of the rows in metrics.jsonl. A killed process may leave half a row."""
    try:
        lines = (folder / "metrics.jsonl").read_text().split("\n")[:-1]
    except FileNotFoundError:
        return []
    return [json.loads(line)["samples"] for line in lines]


def saved_after(folder, step):
    """Returns True if there is a checkpoint after `step`."""
    saved = checkpoint.list_checkpoints(folder / "checkpoints")
    return any(checkpoint.step_of(path) > step for path in saved)


@pytest.mark.parametrize("learner", ["ppo", "r2d2"])
def test_run_survives_signals_and_kills(tmp_path, monkeypatch, learner):
    """Thirty processes continue one run. Each trains for a random time, and gets a signal."""
    monkeypatch.chdir(tmp_path)
    words = [word for word in tiny.TINY if learner == "ppo" or "n_minibatches" not in word]
    words += [f"learner={learner}", "samples=1e9", "checkpoint_seconds=0.05", "log_every=1"]
    draw, folder, step = random.Random(1), tmp_path / "run", 0
    for cycle in range(30):
        case, number = ["resume=run"] if cycle else [*words, "folder=run"], draw.choice(SIGNALS)
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "train.py"), *case],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        first = checkpoint.load_latest(folder / "checkpoints").step if cycle else 0
        wait_until(functools.partial(saved_after, folder, first), process)
        time.sleep(draw.uniform(0, 1))
        process.send_signal(number)
        _, error = process.communicate(timeout=HUNG)
        killed = number == signal.SIGKILL
        assert process.returncode == (-number if killed else 128 + number), (cycle, error)
        assert "Traceback" not in error, (cycle, error)
        step, before = checkpoint.load_latest(folder / "checkpoints").step, step
        rows = samples_in(folder)
        assert step > before and rows == sorted(set(rows)), (cycle, number, before, step)
        assert killed or step >= rows[-1], (cycle, number)
    assert train.main(["resume=run", f"samples={step + tiny.UPDATE}"]) == 0
    assert samples_in(folder) == [*range(tiny.UPDATE, step + tiny.UPDATE + 1, tiny.UPDATE)]
    assert evaluate.main(["run=run", "episodes=4"]) == 0


def resources():
    """Returns this process's memory in MB and its number of open files."""
    pages = int(pathlib.Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 1e6, len(os.listdir("/proc/self/fd"))


STEPPED = {
    "explorer": lambda homes: envs.Explorer(32, homes, device="cpu", resample=True),
    "pointgoal": lambda homes: envs.PointGoal(32, homes, device="cpu", resample=True),
    "deathmatch": lambda homes: envs.Deathmatch(8, homes, n_agents=4, device="cpu"),
    "pong": lambda homes: envs.Pong(256, device="cpu", self_play=True),
}


@pytest.mark.parametrize("name", STEPPED)
def test_environment_stepped_for_long(name):
    """No body is in a wall, every number is finite, and neither memory nor open files grow."""
    homes = sample("bench", 16)
    env, early = STEPPED[name](homes), None
    n_lanes, n_actions = env.n_envs * getattr(env, "n_agents", 1), env.action_space.n_actions
    generator = torch.Generator().manual_seed(1)
    env.reset()
    for step in itertools.count(1):
        actions = torch.randint(n_actions, (n_lanes, 1), generator=generator)
        world = env.step(arrdict(actions=actions))
        if step % 500:
            continue
        env.check()
        assert all(
            bool(leaf.isfinite().all()) for leaf in leaves(world) if leaf.is_floating_point()
        )
        if hasattr(env, "core"):
            layouts, positions = env.core.scenery.layout, env.core.agents.positions.double()
            for layout, points in zip(layouts.tolist(), positions.numpy()):
                nearest = distances(points, homes[layout].walls.astype(float)).min()
                assert nearest > engine.AGENT_RADIUS - 1e-3, (step, layout)
        if step == 5_000:
            early = resources()
        if step == 20_000:
            break
    memory, files = resources()
    assert memory - early[0] < 8 and files == early[1], (early, memory, files)
