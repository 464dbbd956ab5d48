"""Environments and cores in the benchmark's homes whose agents take random actions.

The actions are drawn on the device beforehand. B lanes.
"""

import itertools
from collections.abc import Callable
from typing import Any

import torch
from timing import N_CALLS

from megastep import arrdict, capture, core, envs, modules, scene
from megastep.geometries import sample

N_HOMES = 512
N_WARM_UP = 60  # steps before timing, so that agents have left their spawn points


def random_actions(
    space: Any, n_lanes: int, device: torch.device, n: int = N_CALLS
) -> list[arrdict.arrdict]:
    """Returns ``n`` decisions with uniformly random actions of a discrete space."""
    shape = n_lanes, *space.shape
    return [
        arrdict.arrdict(actions=torch.randint(space.n_actions, shape, device=device))
        for _ in range(n)
    ]


def walk(env: Any, n_actions: int = N_CALLS) -> tuple[Any, Callable[[], object]]:
    """Returns the environment, its step captured on a GPU, and a function that steps it.

    Has taken N_WARM_UP steps. The function repeats ``n_actions`` random decisions.
    """
    n_lanes = env.n_envs * env.n_agents
    decisions = random_actions(env.action_space, n_lanes, env.device, n_actions)
    captured, decision = capture.Captured(env), itertools.cycle(decisions)
    captured.reset()
    for _ in range(N_WARM_UP):
        captured.step(next(decision))
    return captured, lambda: captured.step(next(decision))


def walk_in_homes(
    name: str, n_envs: int, device: torch.device, n_actions: int = N_CALLS, **settings
) -> tuple[Any, Callable[[], object]]:
    """Returns :func:`walk` of ``envs.ENVS[name]`` in the benchmark's homes."""
    homes = sample("bench", N_HOMES)
    return walk(envs.ENVS[name](n_envs, homes, device=device, **settings), n_actions)


def walk_in_rollouts(
    name: str, n_envs: int, device: torch.device, **settings
) -> tuple[Any, Callable[[int], object]]:
    """Returns ``envs.ENVS[name]`` in the benchmark's homes, after N_WARM_UP steps, and a function
    that steps it by the i-th random actions. It is not captured: many steps make one graph.
    """
    env = envs.ENVS[name](n_envs, sample("bench", N_HOMES), device=device, **settings)
    decisions = random_actions(env.action_space, n_envs * env.n_agents, device)
    env.reset()
    for i in range(N_WARM_UP):
        env.step(decisions[i % N_CALLS])
    return env, lambda i: env.step(decisions[i])


def walk_four_agents(
    n_envs: int, device: torch.device
) -> tuple[core.Core, Callable[[int], object]]:
    """Returns a core with four agents per home, and a function that moves them by the i-th actions.

    Each agent has 512 rays over 70 degrees.
    """
    homes = sample("bench", N_HOMES)
    c = core.Core(scene.scenery(homes, 4, n_envs=n_envs, device=device), res=512, fov=70)
    modules.RandomSpawns(homes, c)(c.agent_full(True))
    movement = modules.MomentumMovement(c)
    decisions = random_actions(movement.space, n_envs, device)
    for i in range(N_WARM_UP):
        movement(decisions[i % N_CALLS])
    return c, lambda i: movement(decisions[i])
