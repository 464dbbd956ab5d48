"""What the benchmarks measure: each is a generator of measurements, and ``BENCHMARKS`` names them.

All run in the benchmark's homes, with random actions drawn beforehand on the device.
"""

import itertools
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from counters import counters
from replays import replay
from timing import TURNS, alone, laps, measurement, rate, timed
from trainings import ablation, duels, learners, train, worlds

from megastep import arrdict, capture, core, engine, envs, modules, scene
from megastep.geometries import sample

ROOT = Path(__file__).resolve().parents[2]
SIZES = {"cuda": (1024, 2048, 4096, 8192, 16_384, 65_536, 262_144, 1_048_576), "cpu": (1024, 8192)}
KERNEL_SIZES = {"cuda": (8192, 262_144), "cpu": (2048,)}
ARENAS = {"cuda": (1024, 8192, 65_536), "cpu": (1024,)}  # homes of four agents each
HOMES = 512
WARM_UP = 60  # steps, so that agents are not where they spawned
FRESH = 3  # samples of what takes a process each


def random_actions(n_envs, n_agents, device, turns=TURNS):
    return [
        arrdict.arrdict(actions=torch.randint(7, (n_envs, n_agents), device=device))
        for _ in range(turns)
    ]


def stepper(name, n_envs, device, turns=TURNS):
    """An environment that has been walked about in, and a function that takes its next step,
    captured on a GPU.
    """
    env = capture.Captured(envs.ENVS[name](n_envs, sample("bench", HOMES), device=device))
    actions = itertools.cycle(random_actions(n_envs * env.n_agents, 1, device, turns))
    env.reset()
    for _ in range(WARM_UP):
        env.step(next(actions))
    return env, lambda: env.step(next(actions))


def four_agents(n_envs, device):
    """A core of four agents per home, 512 rays over 70 degrees, that have walked about, and a
    function that moves them by the i-th actions.
    """
    homes = sample("bench", HOMES)
    c = core.Core(scene.scenery(homes, 4, n_envs=n_envs, device=device), res=512, fov=70)
    modules.RandomSpawns(homes, c)(c.agent_full(True))
    movement, actions = modules.MomentumMovement(c), random_actions(n_envs, 4, device)
    for i in range(WARM_UP):
        movement(actions[i % TURNS])
    return c, lambda i: movement(actions[i])


def operations(n, device):
    """(name, function of a turn) of every operation that a step is made of, for ``n`` agents."""
    env, _ = stepper("explorer", n, device)
    scenery, seers, actions = env.core.scenery, env.core.agents, random_actions(n, 1, device)
    some = torch.rand((n, 1), device=device) < 1 / 256  # about as many as end an episode in a step
    stream = modules.CounterGenerator(n, 1, device)
    yield "`physics`", lambda i: env.movement(actions[i])
    yield "`spawn` of 1 in 256", lambda i: env.spawner(some)
    yield "`uniform` of 1 in 256", lambda i: stream(some)
    yield (
        "`observe` as Explorer does, 256 rays to 64 pixels",
        lambda i: engine.observe(scenery, seers, 4, imu=True, seen=env.seen, clear_mask=some),
    )
    visible = modules.visible_texels(scenery, env.spawner.points)
    yield "`unseen`", lambda i: engine.unseen(scenery, seers, env.seen, visible)
    yield "`render`, 256 rays, all fields", lambda i: engine.render(scenery, seers)
    minimal, _ = stepper("minimal", n, device)
    yield (
        "`observe` as Minimal does, RGB of 64 rays",
        lambda i: engine.observe(minimal.core.scenery, minimal.core.agents, depth=False),
    )
    c, _ = four_agents(n // 4, device)
    yield (
        "`update_agent_geometry`, lit, 4 per home",
        lambda i: engine.update_agent_geometry(c.scenery, c.agents),
    )


# ---- The benchmarks ----


def step(device):
    """`env.step` of whole environments with everything they do: frames per second."""
    for name in ("explorer", "minimal", "pointgoal"):
        for n_envs in SIZES[device.type]:
            times = timed(stepper(name, n_envs, device)[1], device)
            yield rate(f"{name}, `env.step`, {n_envs:,} environments", n_envs, times)


def kernels(device):
    """Each operation alone; on a GPU sixteen in one CUDA graph."""
    for n in KERNEL_SIZES[device.type]:
        for what, function in operations(n, device):
            yield measurement(
                f"{what}, {n:,} agents",
                "ns per agent",
                [t / n * 1e9 for t in alone(function, device)],
            )


def observe(device):
    """One image of 256 rays over 130 degrees: all fields at full resolution, and the fused pass."""
    n_envs = KERNEL_SIZES[device.type][-1]
    env, _ = stepper("explorer", n_envs, device)
    scenery, seers = env.core.scenery, env.core.agents
    full_res = alone(lambda i: engine.render(scenery, seers), device)
    fused = alone(lambda i: engine.observe(scenery, seers, 4), device)
    yield rate("`render`, 256 rays, all fields", n_envs, full_res, "M cameras/s")
    yield rate("`observe`, 256 rays to 64 pixels of RGB and depth", n_envs, fused, "M cameras/s")


def agents(device):
    """Four agents per home that see each other, lit: physics, geometry, light, rendering of 512
    rays to 128 pixels over 70 degrees.
    """
    n_envs = 65_536 if device.type == "cuda" else 1024
    c, move = four_agents(n_envs, device)

    def work(i):
        move(i)
        engine.observe(c.scenery, c.agents, 4, imu=True, centre_line=True)

    yield rate("4 agents, 512 rays to 128 pixels, agent-frames", 4 * n_envs, alone(work, device))


def deathmatch(device):
    """Deathmatch's `env.step` of four agents per home with everything it does, and the same physics
    and sight without the game.
    """
    for n_envs in ARENAS[device.type]:
        env, work = stepper("deathmatch", n_envs, device)
        c, n, actions = env.core, env.n_agents * n_envs, random_actions(n_envs, 4, device)

        def without(i, env=env, c=c, actions=actions):
            env.movement(actions[i])
            engine.observe(c.scenery, c.agents, env.subsample, imu=True, centre_line=True)

        whole, part = timed(work, device), alone(without, device)
        yield rate(f"deathmatch, `env.step`, {n_envs:,} homes of 4, agent-frames", n, whole)
        yield rate(f"deathmatch without its game, {n_envs:,} homes of 4, agent-frames", n, part)


def memory(device):
    """What one more environment takes, from the tensors that make it up; on a GPU also the most
    that was allocated while the largest number of environments was made and walked about in.
    """
    sizes = []
    for n_envs in (1024, 2048):
        tree = capture.state_tree(stepper("explorer", n_envs, device)[0].env)
        sizes.append(sum(leaf.nbytes for leaf in tree.values() if isinstance(leaf, torch.Tensor)))
    yield measurement(
        "memory of an Explorer environment beside the homes",
        "bytes",
        [(sizes[1] - sizes[0]) / 1024],
    )
    if device.type == "cuda":
        n_envs = SIZES["cuda"][-1]
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        stepper("explorer", n_envs, device, turns=1)
        peak = torch.cuda.max_memory_allocated(device) - before
        yield measurement(
            f"explorer, {n_envs:,} environments, peak memory allocated", "GB", [peak / 1e9]
        )


BEGIN = """
import time, torch
device = torch.device('{device}')
if device.type == 'cuda': torch.zeros(1, device=device)
"""
BUILD = (
    BEGIN
    + """
from megastep.kernels import compile
start = time.perf_counter()
compile.cuda(device.index or 0, compile.ENGINE) if device.type == 'cuda' else compile.cpu()
print(time.perf_counter() - start)
"""
)
FIRST = (
    BEGIN
    + """
from megastep import arrdict, envs, toys
start = time.perf_counter()
env = envs.Explorer(64, [toys.box()], device=device)
env.reset()
actions = torch.zeros((64, 1), dtype=torch.long, device=device)
env.step(arrdict.arrdict(actions=actions)).reward.tolist()
print(time.perf_counter() - start)
"""
)


def fresh(code, device, n):
    """The seconds that ``code`` prints in ``n`` processes of its own, one after another, that share
    an empty cache; the driver's too, which keeps what NVRTC built.
    """
    with tempfile.TemporaryDirectory() as cache:
        return [
            float(
                subprocess.run(
                    [sys.executable, "-c", code.format(device=device)],
                    text=True,
                    check=True,
                    cwd=ROOT,
                    stdout=subprocess.PIPE,
                    env={**os.environ, "MEGASTEP_CACHE": cache, "CUDA_CACHE_PATH": cache},
                ).stdout
            )
            for _ in range(n)
        ]


def pong(device):
    """Pong's `env.step`, of features and of pictures; of pictures also beside filling as many bytes
    with zeros, the best of many rounds, on one thread of the CPU.
    """
    for pixels, n_envs in itertools.product((False, True), SIZES[device.type]):
        what = f"pong, {'pictures' if pixels else 'features'}, `env.step`, {n_envs:,} environments"
        yield rate(what, n_envs, timed(pong_stepper(n_envs, device, pixels)[1], device))
    if device.type == "cpu":
        yield from pong_and_zeros(device)


def pong_stepper(n_envs, device, pixels):
    """Pong that has been played for a while, and a function that takes its next step, captured on a
    GPU.
    """
    env = capture.Captured(envs.Pong(n_envs, pixels=pixels, device=device))
    drawn = torch.randint(3, (TURNS, n_envs, 1), device=device)
    actions = itertools.cycle([arrdict.arrdict(actions=some) for some in drawn])
    env.reset()
    for _ in range(WARM_UP):
        env.step(next(actions))
    return env, lambda: env.step(next(actions))


def pong_and_zeros(device, n_envs=10_000, rounds=300):
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        env, work = pong_stepper(n_envs, device, pixels=True)
        pictures = env.reset().obs
        pairs = [
            [laps(one, device, 1, 1)[0] / n_envs * 1e9 for one in (work, pictures.zero_)]
            for _ in range(rounds)
        ]
    finally:
        torch.set_num_threads(threads)
    for what, times in zip(("`env.step`", "zeros in their place"), zip(*pairs)):
        name = f"pong, pictures of {n_envs:,} environments, {what}, one thread, best of {rounds}"
        yield measurement(name, "ns per environment", [min(times)])


def compile(device):
    """All kernels built with an empty cache: by NVRTC for a GPU, by a C++ compiler for the CPU."""
    yield measurement(
        "build of all kernels, cold cache",
        "s",
        [fresh(BUILD, device, 1)[0] for _ in range(FRESH)],
    )


def first(device):
    """From imports, and a CUDA context, to the first step of 64 environments: with an empty cache,
    and again.
    """
    pairs = [fresh(FIRST, device, 2) for _ in range(FRESH)]
    for what, times in zip(("cold", "warm"), zip(*pairs)):
        yield measurement(f"first `env.step` after import, {what} cache", "s", times)


def startup(device):
    """From the command `python train.py geometry=bench` to the end of its first update, caches
    warm.
    """
    times = []
    for _ in range(FRESH + 1):  # the first fills the caches
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "train.py", "geometry=bench", "samples=1", "log_every=1"]
            start = time.perf_counter()
            with subprocess.Popen(
                [*command, f"folder={folder}/run", f"device={device}"],
                cwd=ROOT,
                stdout=subprocess.PIPE,
                text=True,
            ) as process:
                next(line for line in process.stdout if " samples" in line)
                times.append(time.perf_counter() - start)
                process.communicate()
    yield measurement("command to first update, warm cache", "s", times[1:])


def cpu(device):
    """The CPU backend on one and two threads, and against the brute-force twin in PyTorch on
    one.
    """
    threads, times, n_envs = torch.get_num_threads(), {}, KERNEL_SIZES["cpu"][-1]
    try:
        for n in (2, 1):
            torch.set_num_threads(n)
            env, work = stepper("explorer", n_envs, device)
            times[n] = timed(work, device)
        env_index = itertools.cycle(range(8))
        slow = timed(lambda: twin_frame(env.core, next(env_index)), device, 8)
    finally:
        torch.set_num_threads(threads)
    yield rate("CPU, Explorer, `env.step`, one thread", n_envs, times[1], "k/s")
    yield measurement(
        "CPU, one to two threads", "times", [one / two for one, two in zip(times[1], times[2])]
    )
    yield measurement(
        "CPU, Explorer, against the twin in PyTorch on one thread",
        "times",
        [t * n_envs / one for t, one in zip(slow, times[1])],
    )


def twin_frame(c, e):
    """One frame of environment ``e`` by the twin: physics, rays, shading."""
    from tests.helpers import twin

    layouts, seers, d = c.scenery.layouts, c.agents, int(c.scenery.layout[e])
    walls, first_wall = layouts.lines[d], int(layouts.wall_starts[d])
    twin.physics(
        walls, seers.positions[e], seers.angles[e], seers.velocity[e], seers.angvelocity[e]
    )
    hits = twin.raycast(walls, seers.positions[e], twin.rays(seers.angles[e], [0.0], 256, 130.0))
    bounds = layouts.texel_starts[first_wall : first_wall + len(walls) + 1].long()
    texels = layouts.texels[int(bounds[0]) : int(bounds[-1])]
    twin.shade(hits, texels[:, :3], bounds.diff(), texels[:, 3])


BENCHMARKS = {
    benchmark.__name__: benchmark
    for benchmark in (
        *(step, kernels, counters, observe, agents, deathmatch, memory, replay),
        *(pong, compile, first, startup, cpu, train, worlds, duels, ablation, learners),
    )
}
