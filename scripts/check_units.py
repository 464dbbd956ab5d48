"""Trains in other units of observations and rewards, and prints a table of returns.

    python scripts/check_units.py                  # CartPole and Pendulum, on a CPU
    python scripts/check_units.py explorer         # on a GPU
    python scripts/check_units.py cartpole --seeds 1 2 --jobs 2

Returns are the last ones of training, in the environment's own units: mean and range over seeds. In
each row they should lie in the spread of the first row, the environment as it is.
"""

import argparse
import contextlib
import dataclasses
import io
import itertools
import multiprocessing
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import torch

from megastep import spaces
from megastep.agents import console
from megastep.agents.cli import train as cli
from megastep.agents.runs import json_lines
from megastep.arrdict import arrdict
from megastep.envs import Explorer

#: Factors of observations and rewards.
UNITS = (1, 1), (1e-6, 1), (1e6, 1), (1, 1e-5), (1, 1e5), (1e-6, 1e5), (1e6, 1e-5)
#: Overrides of `train.py` by task.
TASKS = {
    "cartpole": "env=gymnasium env.id=check_units:Units-v0 env.kwargs.of=CartPole-v1 samples=60000",
    "pendulum": "env=gymnasium env.id=check_units:Units-v0 env.kwargs.of=Pendulum-v1 "
    "samples=200000",
    "explorer": "env=check_units:ExplorerInUnits samples=60_000_000",
}
FACTORS = {
    "explorer": "env.obs_factor={} env.reward_factor={}",
    None: "env.kwargs.obs={} env.kwargs.reward={}",
}


class ExplorerInUnits(Explorer):
    """Explorer with float32 observations times a factor, and rewards times another.

    Args:
        obs_factor: of observations.
        reward_factor: of rewards.
        more: arguments of Explorer.
    """

    def __init__(self, *, obs_factor: float = 1.0, reward_factor: float = 1.0, **more):
        super().__init__(**more)
        self.factors = obs_factor, reward_factor
        self.obs_space = spaces.map(
            lambda space: dataclasses.replace(space, dtype=torch.float32), self.obs_space
        )

    def reset(self):
        return self._in_units(super().reset())

    def step(self, decision):
        return self._in_units(super().step(decision))

    def _in_units(self, world):
        obs, reward = self.factors
        scaled = spaces.map(lambda leaf: leaf.float() * obs, world["obs"])
        return arrdict(world, obs=scaled, reward=world["reward"] * reward)


def in_units(of, obs=1.0, reward=1.0, **settings):
    """Returns an environment of Gymnasium in other units.

    Args:
        of: its id.
        obs: factor of observations.
        reward: factor of rewards.
        settings: of the environment.
    """
    import gymnasium
    import numpy as np

    env = gymnasium.make(of, **settings)
    shape = env.observation_space.shape
    space = gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)
    env = gymnasium.wrappers.TransformObservation(env, lambda x: (x * obs).astype("f4"), space)
    return gymnasium.wrappers.TransformReward(env, lambda x: x * reward)


def train(task, units, seed, words):
    """Returns the last return of a run, in the environment's own units."""
    factors = FACTORS.get(task, FACTORS[None]).format(*units)
    with tempfile.TemporaryDirectory() as folder:
        words = [*TASKS[task].split(), *factors.split(), f"seed={seed}", *words]
        words += [f"folder={folder}/run", "logger={}", "checkpoints.seconds=1e6"]
        with contextlib.redirect_stdout(io.StringIO()):
            assert cli.main(words) == 0
        rows = json_lines.read(Path(folder, "run", "metrics.jsonl"))
    return [row for row in rows if "episode/return" in row][-1]["episode/return"] / units[1]


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="*", default=["cartpole", "pendulum"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--jobs", type=int, default=1, help="runs at the same time")
    parser.add_argument("--set", nargs="*", default=[], help="more overrides of train.py")
    options, rows = parser.parse_args(), []
    for task in options.tasks:
        words = options.set if task == "explorer" else ["device=cpu", *options.set]
        cases = [(task, *case, words) for case in itertools.product(UNITS, options.seeds)]
        context = multiprocessing.get_context("fork")  # before anything is on a GPU
        with ProcessPoolExecutor(options.jobs, context) as pool:
            returns = iter([*pool.map(train, *zip(*cases))])
        for units in UNITS:
            values = [next(returns) for _ in options.seeds]
            factors = [f"{factor:g}" for factor in units]
            mean, span = sum(values) / len(values), f"{min(values):.4g} to {max(values):.4g}"
            rows.append([task, *factors, f"{mean:.4g}", span])
            console.say("  ".join(rows[-1]))
    head = ["task", "observations x", "rewards x", "return", "over seeds"]
    console.say(console.table(head, rows, is_markdown=True))


if __name__ == "__main__":
    main()
else:  # the module of the environment's id
    import gymnasium

    gymnasium.register("Units-v0", in_units)
