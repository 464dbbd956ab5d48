"""Benchmark of PointGoal's shortest paths: `paths`."""

import os
import tempfile
import time
from collections.abc import Iterator
from unittest import mock

import torch
from timing import measurement

from megastep import core, engine, geometries, scene
from megastep.envs.pointgoal.goals import goal_fields

N_HOMES = 512
N_SAMPLES = 3


def paths(device: torch.device) -> Iterator[dict]:
    """Goals, spawn points and shortest paths of PointGoal in all homes of the benchmark, from
    nothing but built kernels.
    """
    homes = geometries.sample("bench", N_HOMES, split="all")
    scenery = scene.scenery(homes, n_envs=N_HOMES, device=device)
    goal_fields(homes[:1], core.Core(scenery, res=64))  # builds the kernels
    seconds = []
    for seed in range(N_SAMPLES):
        settings = core.Core(scenery, res=64, seed=seed)
        with tempfile.TemporaryDirectory() as cache:
            with mock.patch.dict(os.environ, MEGASTEP_CACHE=cache):
                start = time.perf_counter()
                goal_fields(homes, settings)
                if device.type == "cuda":
                    torch.cuda.synchronize(device)
                seconds.append(time.perf_counter() - start)
    where = f", {engine.threads()} threads" if device.type == "cpu" else ""
    yield measurement(f"shortest paths in {N_HOMES} homes, nothing cached{where}", "s", seconds)
