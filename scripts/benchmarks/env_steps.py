"""Benchmarks of whole environments: `step`, `objects`, `hideandseek`, `mazes`, `deathmatch`,
`pong`, `memory`.
"""

import itertools
from collections.abc import Iterator

import torch
from random_walks import N_HOMES, random_actions, walk, walk_in_homes, walk_in_rollouts
from timing import graph_seconds_per_call, lap_seconds, measurement, rate, seconds_per_call

from megastep import capture, engine, envs, modules
from megastep.geometries import sample

N_ENVS = {"cuda": (1024, 2048, 4096, 8192, 16_384, 65_536, 262_144, 1_048_576), "cpu": (1024, 8192)}
N_ENVS_IN_ROLLOUTS = {"cuda": (1024, 4096, 8192, 16_384), "cpu": (1024,)}
N_ENVS_WITH_OBJECTS = {"cuda": (4096, 262_144), "cpu": (1024,)}
N_ARENAS = {"cuda": (1024, 8192, 65_536), "cpu": (1024,)}  # homes of four agents each
#: What a plain step leaves out because it is only read in training and evaluation, by environment.
PLAIN = {"explorer": dict(metrics=False)}
#: Explorer's settings in training: a new home per episode, a privileged observation, metrics.
AS_TRAINED = dict(resample=True, privileged=True, metrics=True)


def step(device: torch.device) -> Iterator[dict]:
    """Frames per second of the whole `env.step` with default settings; Explorer without its
    metrics. A step is a CUDA graph; "in a rollout", 16 steps are one. "As trained" is Explorer with
    the settings of training: a new home for every episode, a privileged observation for the critic,
    and metrics.
    """
    for name in ("explorer", "minimal", "pointgoal"):
        for n_envs in N_ENVS[device.type]:
            _, take_step = walk_in_homes(name, n_envs, device, **PLAIN.get(name, {}))
            seconds = seconds_per_call(take_step, device)
            yield rate(f"{name}, `env.step`, {n_envs:,} environments", n_envs, seconds)
    for n_envs in N_ENVS_IN_ROLLOUTS[device.type]:
        for suffix, settings in (("", PLAIN["explorer"]), (", as trained", AS_TRAINED)):
            _, take_step = walk_in_rollouts("explorer", n_envs, device, **settings)
            what = f"explorer, `env.step`, {n_envs:,} environments{suffix}, in a rollout"
            yield rate(what, n_envs, graph_seconds_per_call(take_step, device))


def objects(device: torch.device) -> Iterator[dict]:
    """Frames per second of Explorer's `env.step`, without its metrics, in homes without objects and
    with six: solid crates of four lines, and discs of six that nobody bumps into.
    """
    kinds = {
        "none": None,
        "six crates": modules.Crate(6, 0.2),
        "six movable crates": modules.Crate(6, 0.2, movable=True),
        "six discs": modules.Disc(6),
    }
    for n_envs in N_ENVS_WITH_OBJECTS[device.type]:
        homes = sample("bench", min(N_HOMES, n_envs))
        for name, kind in kinds.items():
            env = envs.Explorer(n_envs, homes, device=device, metrics=False)
            if kind is not None:
                things = modules.Objects(homes, env.core, {"thing": kind})["thing"]
                things.place(torch.ones(n_envs, dtype=torch.bool, device=device))
            _, take_step = walk(env)
            what = f"explorer, `env.step`, {n_envs:,} environments, objects: {name}"
            yield rate(what, n_envs, seconds_per_call(take_step, device))


def hideandseek(device: torch.device) -> Iterator[dict]:
    """Agents' frames per second of hide and seek as trained, with four agents and nine bodies: of
    both variants, and with bodies that nothing moves.
    """
    bodies = dict(n_boxes=6, n_long=2, n_ramps=1, resample=True, privileged=True)
    cases = ("quadrant", True), ("quadrant", False), ("homes", True)
    for n_envs, (variant, movable) in itertools.product(N_ENVS_WITH_OBJECTS[device.type], cases):
        rooms, options = sample(variant, N_HOMES), dict(variant=variant, movable=movable, **bodies)
        _, take_step = walk(envs.HideAndSeek(n_envs, rooms, device=device, **options))
        what = f"hide and seek, `env.step`, {n_envs:,} environments of 4 agents, {variant}"
        what += ", 9 bodies" + ("" if movable else " that stay")
        yield rate(what, 4 * n_envs, seconds_per_call(take_step, device))


def mazes(device: torch.device) -> Iterator[dict]:
    """Frames per second of Memory's `env.step`, with as many objects as its recipes have, and of
    Explorer's, without its metrics, in the same mazes.
    """
    kinds = {"explorer": dict(metrics=False), "memory": {}}
    for size, n_objects in ((9, 3), (15, 6)):
        plans = sample("memory_maze", N_HOMES, size=size)
        kinds["memory"] = dict(objects=n_objects)
        for n_envs, (name, settings) in itertools.product(
            N_ENVS_WITH_OBJECTS[device.type], kinds.items()
        ):
            _, take_step = walk(envs.ENVS[name](n_envs, plans, device=device, **settings))
            what = f"{name}, `env.step`, {n_envs:,} environments, mazes of {size} x {size} cells"
            yield rate(what, n_envs, seconds_per_call(take_step, device))


def deathmatch(device: torch.device) -> Iterator[dict]:
    """Deathmatch's `env.step` with four agents per home, and the same physics and rendering without
    the rules of the game.
    """
    for n_envs in N_ARENAS[device.type]:
        env, take_step = walk_in_homes("deathmatch", n_envs, device)
        n_frames = env.n_agents * n_envs
        decisions = random_actions(env.movement.space, n_envs, device)

        def move_and_render(i, env=env, decisions=decisions):
            env.movement(decisions[i])
            scenery, agents = env.core.scenery, env.core.agents
            engine.observe(scenery, agents, env.subsample, imu=True, centre_line=True)

        game = seconds_per_call(take_step, device)
        without_game = graph_seconds_per_call(move_and_render, device)
        homes = f"{n_envs:,} homes of 4, agent-frames"
        yield rate(f"deathmatch, `env.step`, {homes}", n_frames, game)
        yield rate(f"deathmatch without its game, {homes}", n_frames, without_game)


def pong(device: torch.device) -> Iterator[dict]:
    """Pong's `env.step` with features and with images. On the CPU also one thread's best time for a
    step with images, next to filling as many bytes with zeros.
    """
    for pixels, n_envs in itertools.product((False, True), N_ENVS[device.type]):
        what = f"pong, {'pictures' if pixels else 'features'}, `env.step`, {n_envs:,} environments"
        _, take_step = walk(envs.Pong(n_envs, pixels=pixels, device=device))
        yield rate(what, n_envs, seconds_per_call(take_step, device))
    if device.type == "cpu":
        yield from pong_beside_zeros(device)


def pong_beside_zeros(
    device: torch.device, n_envs: int = 10_000, n_rounds: int = 300
) -> Iterator[dict]:
    """Measures a step of Pong and a fill of its images in turn, on one thread."""
    n_threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        env, take_step = walk(envs.Pong(n_envs, pixels=True, device=device))
        images = env.reset().obs
        rounds = [
            [
                lap_seconds(function, device, 1, 1)[0] / n_envs * 1e9
                for function in (take_step, images.zero_)
            ]
            for _ in range(n_rounds)
        ]
    finally:
        torch.set_num_threads(n_threads)
    for what, times in zip(("`env.step`", "zeros in their place"), zip(*rounds)):
        name = f"pong, pictures of {n_envs:,} environments, {what}, one thread, best of {n_rounds}"
        yield measurement(name, "ns per environment", [min(times)])


def memory(device: torch.device) -> Iterator[dict]:
    """Memory that one more Explorer environment takes, from the sizes of its tensors. On a GPU also
    the peak allocation while the largest number of environments is created and stepped.
    """
    n_bytes = []
    for n_envs in (1024, 2048):
        env, _ = walk_in_homes("explorer", n_envs, device)
        state = capture.state_tree(env.env).values()
        n_bytes.append(sum(leaf.nbytes for leaf in state if isinstance(leaf, torch.Tensor)))
    yield measurement(
        "memory of an Explorer environment beside the homes",
        "bytes",
        [(n_bytes[1] - n_bytes[0]) / 1024],
    )
    if device.type == "cuda":
        n_envs = N_ENVS["cuda"][-1]
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        walk_in_homes("explorer", n_envs, device, n_actions=1)
        peak = torch.cuda.max_memory_allocated(device) - before
        yield measurement(
            f"explorer, {n_envs:,} environments, peak memory allocated", "GB", [peak / 1e9]
        )
