"""The PPO in one file: it learns, and its command line works."""

import runpy
import sys

import ppo_single_file
import pytest

from tests.algorithms.test_learning import Cue, Reach


@pytest.mark.nightly
@pytest.mark.parametrize("make, first, last", [(Cue, 0.4, 0.9), (Reach, 1.0, 3.2)])
def test_ppo_learns(make, first, last):
    """At best returns are 1 and 4; without memory or a look at the goal, 1/4 and less than 0."""
    settings = ppo_single_file.Settings(
        width=32,
        n_steps=16,
        n_epochs=2,
        lr=1e-2,
        entropy_coef=1e-3,
        samples=60 * 16 * 64,
        log_every=4,
    )
    _, reports = ppo_single_file.train(settings, make())
    returns = [report["return"] for report in reports if "return" in report]
    assert returns[0] < first and returns[-1] > last


@pytest.mark.slow
def test_command_line(monkeypatch, capsys):
    def run(words):
        monkeypatch.setattr(sys, "argv", ["ppo_single_file.py", *words.split()])
        runpy.run_path(ppo_single_file.__file__, run_name="__main__")

    small = "--n-envs 8 --width 8 --device cpu"
    run(f"--env megastep.envs.pong:Pong {small} --samples 6_000 --log-every 10 limit=20")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["2,560", "5,120", "5,888"]
    assert all("  return " in line for line in lines[1:])  # the first episodes have not all ended
    homes = "--homes 3 --samples 512 control=continuous res=64"
    run(f"--env megastep.envs.pointgoal:PointGoal {small} {homes}")
    for words, sentence in {
        "--env megastep.envs.pong:Pongo": "did you mean Pong?",
        "--env megastep.envs.pong:Pong --n-envs 3": "3 lanes cannot be split into more minibatches",
        "--env megastep.envs.pong:Pong limit=0": "limit",
        "--device tpu": "tpu",
    }.items():
        with pytest.raises(SystemExit) as ending:
            run(words)
        assert ending.value.code == 2 and sentence in capsys.readouterr().err
