"""Long use: a run that is interrupted, killed and resumed again and again, and environments that
are stepped for long.
"""

import itertools
import os
import pathlib
import signal

import pytest
import soak
import torch

from megastep import engine, envs
from megastep.agents.cli import inspect
from megastep.agents.runs import checkpoint
from megastep.arrdict import arrdict
from megastep.dotdict import leaves
from megastep.geometries import sample
from megastep.modules.spawning import distances
from tests.helpers import tiny
from tests.helpers.processes import finished, start, wait_until

pytestmark = pytest.mark.nightly


@pytest.mark.parametrize("seed", [1, 2])
def test_disturbed_runs_end_like_those_left_alone(seed):
    """Signals, kills, full disks and damaged checkpoints, at random moments."""
    assert soak.main(["--minutes", "5", "--seed", str(seed)]) == 0


def resources():
    """Returns this process's memory in MB and its number of open files."""
    pages = int(pathlib.Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 1e6, len(os.listdir("/proc/self/fd"))


STEPPED = {
    "explorer": lambda homes: envs.Explorer(32, homes, device="cpu", resample=True),
    "pointgoal": lambda homes: envs.PointGoal(32, homes, device="cpu", resample=True),
    "deathmatch": lambda homes: envs.Deathmatch(8, homes, n_agents=4, device="cpu", resample=True),
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


def test_commands_beside_a_run_that_is_training(tmp_path):
    """A checkpoint after each update, so that each is deleted at once."""
    words = ["checkpoints.seconds=1e-3", "logger=none", "folder=run"]
    training = start("train", *tiny.TINY, *words, cwd=tmp_path)
    saved = tmp_path / "run/checkpoints"
    wait_until(lambda: saved.is_dir() and checkpoint.list_checkpoints(saved), training)
    played = ["run=run", "device=cpu"]
    for n in range(3):
        for script, *words in (
            ("evaluate", *played, "episodes=4", "baseline=false"),
            ("record", *played, "steps=2"),
            ("train", *tiny.TINY, "init=run", "samples=32", f"folder=next-{n}"),
        ):
            code, out, err = finished(script, *words, cwd=tmp_path)
            assert code == 0 and "damaged" not in out + err and "Traceback" not in err, (
                script,
                err,
            )
            assert inspect.main([str(tmp_path / "run")]) == 0
        assert len([*tmp_path.glob("run/evaluations/*.json")]) > n
    assert len([*tmp_path.glob("run/video*.mp4")]) == 3
    assert training.poll() is None, "it has not ended before"
    training.send_signal(signal.SIGTERM)
    training.communicate()
    names = {path.name for path in saved.rglob("*") if path.is_dir()}
    assert training.returncode == 143 and len(names) <= 3, names
