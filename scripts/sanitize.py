"""Runs every operation on small scenery, also with bad indices, and a few updates of each learner,
for NVIDIA's compute-sanitizer:

for tool in memcheck racecheck initcheck; do
    compute-sanitizer --tool $tool --report-api-errors no python scripts/sanitize.py
done

`python scripts/sanitize.py cpu` runs the same on the CPU; tests/kernels/test_sanitizers.py does so
with kernels built for AddressSanitizer and UndefinedBehaviorSanitizer.
"""

import contextlib
import functools
import itertools
import math
import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from megastep import arrdict, core, engine, envs, scene
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.algorithms.r2d2 import R2D2
from megastep.agents.algorithms.vtrace import VTrace
from megastep.agents.networks.policy import Policy
from megastep.agents.storage.replay import ReplaySettings
from megastep.engine import operations, rendering
from megastep.geometries import sample
from megastep.modules import RandomSpawns
from megastep.types import n_lanes


def out_of_range(c, spawn):
    """Runs operations with a layout that does not exist. They must set a flag and read nothing."""
    spawn.resample = False
    operations = (
        lambda: engine.physics(c.scenery, c.agents),
        lambda: engine.observe(c.scenery, c.agents),
        lambda: engine.render(c.scenery, c.agents),
        lambda: spawn(c.agent_full(True)),
    )
    for layout, operation in itertools.product((-1, 3, 2**31 - 1), operations):
        c.scenery.layout[4] = layout
        try:
            operation()
            engine.check(c.agents)
        except engine.EngineError:
            c.scenery.layout[4] = 0
        else:
            raise AssertionError("a bad layout was not flagged")


def step(env, action):
    """Steps an environment. On the CPU an action out of range raises at once."""
    shape = n_lanes(env), *env.action_space.shape
    actions = torch.full(shape, action, device=env.device)
    with contextlib.suppress(engine.EngineError):
        env.step(arrdict.arrdict(actions=actions))


def run_all(device):
    homes = sample("bench", 3)
    for n_agents, res, cameras in [(1, 63, None), (4, 96, [0, 120, 240])]:
        c = core.Core(
            scene.scenery(homes, n_agents, n_envs=5, device=device), res=res, cameras=cameras
        )
        spawn = RandomSpawns(homes, c, resample=True)
        words = -(-c.scenery.layouts.max_texels // 32)
        seen = torch.zeros((5, n_agents, words), dtype=torch.int32, device=device)
        for _ in range(3):
            spawn(c.agent_full(True))
            c.agents.velocity.fill_(3.0)
            engine.physics(c.scenery, c.agents)
            engine.observe(
                c.scenery,
                c.agents,
                3,
                imu=True,
                centre_line=True,
                seen=seen,
                clear_mask=c.agent_full(False),
            )
            engine.render(c.scenery, c.agents)
        out_of_range(c, spawn)
    everywhere = dict(device=device, resample=True, privileged=True)
    seven, deaths, points = range(7), (*range(7), 7) * 5, (*range(3), 7) * 20
    continuous = envs.Explorer(7, homes, device=device, control="continuous")
    cases = [
        (envs.Explorer(7, homes, device=device), seven),
        (envs.Explorer(7, homes, **everywhere, patience=1), seven),
        (envs.Minimal(7, homes, device=device), seven),
        (continuous, (0.5, -2.0, math.inf, math.nan)),
        (envs.PointGoal(7, homes, **everywhere, cameras=[0, 180]), seven),
        (envs.Memory(7, sample("memory_maze", 2), device=device, privileged=True), seven),
        (envs.Keys(7, sample("homes", 2), device=device, privileged=True), seven),
        (envs.HideAndSeek(7, prep=3, limit=9, **everywhere), range(9)),
    ]
    for n_agents in (2, 16):
        settings = dict(n_agents=n_agents, damage=1, privileged=True)
        cases.append((envs.Deathmatch(7, homes, device=device, **settings), deaths))
    for settings in (dict(), dict(self_play=True), dict(pixels=True, points=2)):
        cases.append((envs.Pong(67, device=device, **settings), points))
    for env, actions in cases:
        env.reset()
        for action in actions:
            step(env, action)
    if device == "cuda":
        torch.cuda.synchronize()


def learn(device, make_learner, n_updates=2, **settings):
    """Collects and learns, with policies wide enough for kernels of clusters and tensor cores."""
    env = envs.Explorer(41, sample("bench", 3), device=device, resample=True, privileged=True)
    policy = Policy(env.obs_space, env.action_space, env.privileged_space, width=256, **settings)
    learner = make_learner(policy.to(device), n_steps=8, graph=False)
    collect = learner.collector(env)
    for _ in range(n_updates):
        metrics = learner.update(collect())
    assert all(torch.isfinite(torch.as_tensor(value)).all() for value in metrics.values())


def learn_all(device):
    """More lanes than a cluster of blocks has, and more steps than wait in its memory."""
    for core_name, encoder in [("lstm", "linear"), ("mingru", "conv"), ("gru", "linear")]:
        learn(device, functools.partial(PPO, n_minibatches=1), core=core_name, encoder=encoder)
    learn(device, VTrace, core="none", layers=2)
    # the first updates collect a whole sequence
    r2d2 = functools.partial(R2D2, replay=ReplaySettings(capacity=10_000))
    learn(device, r2d2, n_updates=7, output="duelling")
    if device == "cuda":
        torch.cuda.synchronize()


def main(device):
    run_all(device)
    learn_all(device)
    if device == "cuda":  # with the kernels that render and move many agents, too
        operations.n_resident_threads = rendering.n_resident_threads = lambda *_: 0
        run_all(device)
    print("done")


if __name__ == "__main__":
    main(*sys.argv[1:] or ["cuda"])
