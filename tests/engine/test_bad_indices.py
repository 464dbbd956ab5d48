"""Whatever is written into an index tensor ends in an error or a picture, never in a signal."""

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from megastep import engine, envs
from megastep.arrdict import arrdict
from megastep.engine.state_tree import walk
from megastep.geometries import sample
from megastep.ragged import Ragged
from megastep.read_only import ReadOnlyTensor
from tests.helpers.cuda_on_cpu import CudaOnCpu

#: The last is in memory, mostly.
VALUES = 2**31 - 1, -(2**31), -1
SEEING = dict(res=8, subsample=2, resample=True, privileged=True)
ENVS = dict.fromkeys(("explorer", "pointgoal", "memory", "keys"), SEEING) | dict(
    deathmatch=dict(**SEEING, n_agents=3, hearing=5.0, search_reward=1.0, aim_reward=1.0),
    hideandseek=dict(**SEEING, variant="homes", prep=0),
    minimal={},
    pong=dict(pixels=True, self_play=True),
    minatar=dict(id="seaquest"),
)
#: Floats whose memory holds integers too.
RECORDS = ".all.records", ".all.bodies", ".runs.runs"


def indices(env):
    """{path: tensor of integers} of all that can be reached from an environment."""
    for _, _, ragged in walk(env, Ragged).values():
        assert len(ragged.starts) == len(ragged.ends) and len(ragged.inverse) >= 0
    found = {}
    for path, (_, _, leaf) in walk(env, torch.Tensor, only_state=False).items():
        leaf = leaf.view(torch.int32) if path.endswith(RECORDS) else leaf
        if leaf.dtype in (torch.int32, torch.int64) and leaf.numel():
            found[path] = leaf
    return found


def use(env, is_cuda):
    """Resets, steps, renders, and moves, by which all kernels of an environment run."""
    actions = torch.ones(env.n_envs * env.n_agents, 1, dtype=torch.int64, device=env.device)
    calls = [env.reset, lambda: env.step(arrdict(actions=actions))]
    if hasattr(env, "core"):
        both = env.core.scenery, env.core.agents
        calls += [lambda: engine.render(*both), lambda: env.check()]
        # whose indices PyTorch checks, on a GPU by ending all
        calls += [] if is_cuda else [lambda: engine.bake(both[0]), lambda: env.state(0)]
    for call in calls:
        with contextlib.suppress(Exception):
            call()


def attack(name, device, values=VALUES):
    geometry = {} if name in ("pong", "minatar") else dict(geometries=sample("homes", 2))
    env = envs.ENVS[name](2, **geometry, **ENVS[name], device=device)
    env.reset()
    leaves = [leaf for _, _, leaf in walk(env, torch.Tensor, only_state=False).values()]
    leaves = [leaf for leaf in leaves if not isinstance(leaf, ReadOnlyTensor)]
    before, n_written = [leaf.clone() for leaf in leaves], 0
    for path, leaf in indices(env).items():
        for value in values:
            print(f"{name}{path} = {value}", flush=True)
            with contextlib.suppress(ValueError):  # of read-only tensors
                leaf.fill_(value)
                n_written += 1
            use(env, device == "cuda")
            for tensor, copy in zip(leaves, before):
                tensor.copy_(copy)
    assert env.reset().reset.all() and n_written
    env.check()


def main(kernels):
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        if kernels == "cuda-on-cpu":
            CudaOnCpu().install(patch)
        for name in ENVS:
            # each night, and on a GPU, also what is in memory
            values = VALUES[:2] if kernels == "cpu" else VALUES
            attack(name, "cuda" if kernels == "cuda" else "cpu", values)


@pytest.mark.parametrize(
    "kernels",
    [
        "cpu",
        pytest.param("cuda-on-cpu", marks=pytest.mark.nightly),
        pytest.param("cuda", marks=pytest.mark.cuda),
    ],
)
def test_indices_out_of_range_crash_nothing(kernels):
    root = Path(__file__).parents[2]
    process = subprocess.run(
        [sys.executable, "-c", "from tests.engine.test_bad_indices import *; main(sys.argv[1])"]
        + [kernels],
        **dict(capture_output=True, text=True, cwd=root),
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(root), *sys.path])},
    )
    last = process.stdout.splitlines()[-1:]
    assert process.returncode == 0, f"it ended in {last}: {process.stderr[-2000:]}"
