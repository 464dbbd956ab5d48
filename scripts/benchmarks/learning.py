"""Benchmarks of learning without the trainer, `ppo`, and of small games, `grids`.

B lanes.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import random_walks
import torch
from random_walks import random_actions
from timing import graph_seconds_per_call, rate, seconds_per_call

from megastep import envs
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.networks.policy import Policy
from megastep.arrdict import arrdict
from megastep.geometries import sample
from megastep.types import Tree

N_WARM_UP = 4  # iterations, in which CUDA graphs are recorded
LSTM: dict = {}
CATEGORIES = dict(encoder="categories")
MINGRU_3X256, MINGRU_1X64 = dict(core="mingru", layers=3), dict(core="mingru", width=64)
N_GRIDS = {"cuda": (8192, 262_144), "cpu": (1024,)}
GRIDS = ("MiniGrid-DoorKey-8x8-v0", "MiniGrid-KeyCorridorS3R3-v0")
GAMES = "asterix", "breakout", "freeway", "seaquest", "space_invaders"


class Run(NamedTuple):
    """What is trained: an environment, "free" for one that costs nothing, with B lanes."""

    env: str
    lanes: int
    minibatches: int
    network: str
    agent: Mapping
    steps: int = 32


RUNS = {
    "cuda": (
        Run("explorer", 4096, 4, "LSTM 256", LSTM),
        Run("explorer", 32_768, 16, "LSTM 256", LSTM),
        Run("explorer", 4096, 4, "minGRU 3 x 256", MINGRU_3X256),
        Run("explorer", 32_768, 16, "minGRU 3 x 256", MINGRU_3X256),
        Run("explorer", 65_536, 8, "minGRU 1 x 64", MINGRU_1X64),
        Run("free", 4096, 4, "minGRU 3 x 256", MINGRU_3X256),
        Run("free", 32_768, 32, "minGRU 3 x 256", MINGRU_3X256),
        Run("free", 65_536, 64, "minGRU 1 x 64", MINGRU_1X64),
        Run("pointgoal", 8192, 8, "LSTM 256", LSTM),
        Run("memory", 4096, 4, "LSTM 3 x 256", dict(layers=3), 64),
        Run("minigrid", 65_536, 8, "minGRU 1 x 64", MINGRU_1X64 | CATEGORIES, 64),
    ),
    "cpu": (Run("explorer", 64, 4, "LSTM 256", LSTM),),
}


class Free:
    """An environment that costs nothing: B lanes that see the same numbers, Explorer's, always."""

    capturable, n_agents = True, 1

    def __init__(self, n_envs: int, device: torch.device):
        like = envs.ENVS["explorer"](1, sample("bench", 1), device=device)
        self.n_envs, self.device = n_envs, device
        self.obs_space, self.action_space = like.obs_space, like.action_space
        shapes = {key: (n_envs, *value.shape[1:]) for key, value in like.reset().obs.items()}
        obs = {key: torch.randn(shape, device=device).half() for key, shape in shapes.items()}
        flags = torch.zeros(3, n_envs, dtype=torch.bool, device=device)
        flags = dict(zip(("reset", "terminal", "truncated"), flags))
        self.world = arrdict(obs=arrdict(obs), reward=torch.randn(n_envs, device=device), **flags)

    def reset(self, seed: object = None, mask: object = None) -> arrdict:
        return self.world

    def step(self, decision: object) -> arrdict:
        return self.world


def ppo(device: torch.device) -> Iterator[dict]:
    """Samples per second of PPO's rollouts and updates in turn, as CUDA graphs, with the recipes'
    settings but without the trainer: no reports, no checkpoints. "Free" is an environment that
    costs nothing, with Explorer's observations.
    """
    for run in RUNS[device.type]:
        env = _environment(run, device)
        sizes = dict(n_steps=run.steps, n_minibatches=run.minibatches)
        learner = PPO(Policy(env, **run.agent), **sizes, graph=True)
        collect = learner.collector(env)

        def iterate(learner=learner, collect=collect):
            learner.update(collect())

        for _ in range(N_WARM_UP):
            iterate()
        what = f"{run.env}, {run.network}, {run.lanes:,} lanes in {run.minibatches} minibatches"
        yield rate(what, run.lanes * run.steps, seconds_per_call(iterate, device))


def _environment(run, device) -> Tree:
    n_homes = random_walks.N_HOMES
    options = dict(device=device, resample=True, privileged=True)
    if run.env == "free":
        return Free(run.lanes, device)
    if run.env == "minigrid":
        return envs.ENVS["minigrid"](run.lanes, id=GRIDS[0], device=device)
    if run.env == "memory":
        return envs.ENVS["memory"](run.lanes, sample("memory_maze", n_homes, size=9), **options)
    return envs.ENVS[run.env](run.lanes, sample("bench", n_homes), **options)


def grids(device: torch.device) -> Iterator[dict]:
    """Steps per second of tasks of MiniGrid and of MinAtar's games, with random actions, 16 steps
    as one CUDA graph.
    """
    names = [*(("minigrid", name) for name in GRIDS), *(("minatar", name) for name in GAMES)]
    for kind, name in names:
        for n_envs in N_GRIDS[device.type]:
            env = envs.ENVS[kind](n_envs, id=name, device=device)
            decisions = random_actions(env.action_space, n_envs, device)
            env.reset()

            def step(i, env=env, decisions=decisions):
                env.step(decisions[i])

            seconds = graph_seconds_per_call(step, device)
            yield rate(f"{name}, `env.step`, {n_envs:,} environments", n_envs, seconds)
