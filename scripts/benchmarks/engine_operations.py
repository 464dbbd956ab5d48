"""Benchmarks of the engine's operations: `kernels`, `observe`, `agents`, `cpu`."""

import itertools
from collections.abc import Callable, Iterator

import torch
from random_walks import random_actions, walk_four_agents, walk_in_homes
from timing import graph_seconds_per_call, measurement, rate, seconds_per_call

from megastep import core, engine, modules

N_AGENTS = {"cuda": (4096, 8192, 262_144), "cpu": (2048,)}
N_ARENAS = {"cuda": 65_536, "cpu": 1024}  # homes of four agents each


def operations(n: int, device: torch.device) -> Iterator[tuple[str, Callable[[int], object]]]:
    """Yields each operation that steps are made of, for ``n`` agents: (name, function of i)."""
    env, _ = walk_in_homes("explorer", n, device)
    scenery, agents = env.core.scenery, env.core.agents
    decisions = random_actions(env.action_space, n, device)
    ended = torch.rand((n, 1), device=device) < 1 / 256  # about the share that ends in a step
    generator = modules.CounterGenerator(n, 1, device)
    yield "`physics`", lambda i: env.movement(decisions[i])
    yield "`spawn` of 1 in 256", lambda i: env.spawner(ended)
    yield "`uniform` of 1 in 256", lambda i: generator(ended)
    yield (
        "`observe` as Explorer does, 256 rays to 64 pixels",
        lambda i: engine.observe(scenery, agents, 4, imu=True, seen=env.seen, clear_mask=ended),
    )
    newly_seen = torch.zeros_like(ended, dtype=torch.int32)
    env.privileged_space = env.privileged_space or True
    yield "`explorer_step` with a privileged observation", lambda i: env._judge(newly_seen)
    yield "`render`, 256 rays, all fields", lambda i: engine.render(scenery, agents)
    minimal, _ = walk_in_homes("minimal", n, device)
    yield (
        "`observe` as Minimal does, RGB of 64 rays",
        lambda i: engine.observe(minimal.core.scenery, minimal.core.agents, depth=False),
    )
    c, _ = walk_four_agents(n // 4, device)
    yield (
        "`update_agent_geometry`, lit, 4 per home",
        lambda i: engine.update_agent_geometry(c.scenery, c.agents),
    )


def kernels(device: torch.device) -> Iterator[dict]:
    """Each operation of the engine by itself. On a GPU, sixteen calls are one CUDA graph."""
    for n in N_AGENTS[device.type]:
        for what, operation in operations(n, device):
            samples = [seconds / n * 1e9 for seconds in graph_seconds_per_call(operation, device)]
            yield measurement(f"{what}, {n:,} agents", "ns per agent", samples)


def observe(device: torch.device) -> Iterator[dict]:
    """Rendering of 256 rays over 130 degrees: all fields at full resolution, and the fused pass
    that training uses.
    """
    n_envs = N_AGENTS[device.type][-1]
    env, _ = walk_in_homes("explorer", n_envs, device)
    scenery, agents = env.core.scenery, env.core.agents
    full = graph_seconds_per_call(lambda i: engine.render(scenery, agents), device)
    fused = graph_seconds_per_call(lambda i: engine.observe(scenery, agents, 4), device)
    yield rate("`render`, 256 rays, all fields", n_envs, full, "M cameras/s")
    yield rate("`observe`, 256 rays to 64 pixels of RGB and depth", n_envs, fused, "M cameras/s")


def agents(device: torch.device) -> Iterator[dict]:
    """Four agents per home that see each other, with lights: physics, geometry, lighting, and
    rendering of 512 rays to 128 pixels over 70 degrees.
    """
    n_envs = N_ARENAS[device.type]
    c, move = walk_four_agents(n_envs, device)

    def move_and_render(i):
        move(i)
        engine.observe(c.scenery, c.agents, 4, imu=True, centre_line=True)

    seconds = graph_seconds_per_call(move_and_render, device)
    yield rate("4 agents, 512 rays to 128 pixels, agent-frames", 4 * n_envs, seconds)


def cpu(device: torch.device) -> Iterator[dict]:
    """The CPU backend on one and two threads, and next to the reference implementation in plain
    PyTorch on one thread.
    """
    n_threads, n_envs, step_seconds = torch.get_num_threads(), N_AGENTS["cpu"][-1], {}
    try:
        for n in (2, 1):
            torch.set_num_threads(n)
            env, take_step = walk_in_homes("explorer", n_envs, device)
            step_seconds[n] = seconds_per_call(take_step, device)
        env_index = itertools.cycle(range(8))
        twin_seconds = seconds_per_call(lambda: twin_frame(env.core, next(env_index)), device, 8)
    finally:
        torch.set_num_threads(n_threads)
    yield rate("CPU, Explorer, `env.step`, one thread", n_envs, step_seconds[1], "k/s")
    speedups = [one / two for one, two in zip(step_seconds[1], step_seconds[2])]
    yield measurement("CPU, one to two threads", "times", speedups)
    speedups = [twin * n_envs / ours for twin, ours in zip(twin_seconds, step_seconds[1])]
    what = "CPU, Explorer, against the twin in PyTorch on one thread"
    yield measurement(what, "times", speedups)


def twin_frame(c: core.Core, e: int) -> None:
    """Computes a frame of environment ``e`` with the tests' twin: physics, rays, shading."""
    from tests.helpers import twin

    layouts, agents, layout = c.scenery.layouts, c.agents, int(c.scenery.layout[e])
    walls, first_wall = layouts.lines[layout], int(layouts.wall_starts[layout])
    positions, angles = agents.positions[e], agents.angles[e]
    twin.physics(walls, positions, angles, agents.velocity[e], agents.angvelocity[e])
    hits = twin.raycast(walls, positions, twin.rays(angles, [0.0], 256, 130.0))
    bounds = layouts.texel_starts[first_wall : first_wall + len(walls) + 1].long()
    texels = layouts.texels[int(bounds[0]) : int(bounds[-1])]
    twin.shade(hits, texels[:, :3], bounds.diff(), texels[:, 3])
