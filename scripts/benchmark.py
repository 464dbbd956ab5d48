"""Measures what docs/benchmarks.md quotes: `python scripts/benchmark.py step observe agents memory first cpu train`.

Prints a Markdown table, a line a figure with what it was measured on; `--file docs/benchmarks.md` appends it there too.
All in the benchmark's homes, with random actions drawn beforehand on the device; times are the best of three runs of
twenty steps, after warming up.
"""
import argparse
import os
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path

os.environ.setdefault('OMP_WAIT_POLICY', 'passive')     # before torch, which would have idle threads spin

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'tests')]

from megastep import arrdict, capture, core, engine, envs, scene  # noqa: E402
from megastep.geometries import sample  # noqa: E402
from megastep.modules import RandomSpawns  # noqa: E402

SIZES = (1024, 8192, 65_536, 262_144, 1_048_576)
WARM_UP = 60        # steps, so that agents are not where they spawned


def seconds(work, device, n=20):
    """Of one call of ``work``."""
    best = float('inf')
    for _ in range(3):
        wait(device)
        start = time.perf_counter()
        for _ in range(n):
            work()
        wait(device)
        best = min(best, (time.perf_counter() - start) / n)
    return best


def wait(device):
    if torch.device(device).type == 'cuda':
        torch.cuda.synchronize(device)


def million(count, time_taken):
    return f'{count / time_taken / 1e6:.2f} M/s'


def stepper(name, n_envs, device, **settings):
    """An environment that has been walked about in, and a function that takes its next step, captured on a GPU."""
    env = capture.Captured(envs.ENVS[name](n_envs, sample('bench', 512), device=device, **settings))
    actions = [arrdict.arrdict(actions=torch.randint(7, (n_envs, 1), device=device)) for _ in range(8)]
    count = iter(range(10**9))

    def step():
        return env.step(actions[next(count) % len(actions)])

    env.reset()
    for _ in range(WARM_UP):
        step()
    return env, step


def step(device):
    """`env.step` of whole environments, everything they do included."""
    for name in ('explorer', 'minimal'):
        for n_envs in SIZES if device.type == 'cuda' else SIZES[:2]:
            env, work = stepper(name, n_envs, device)
            yield f'{name}, `env.step`, {n_envs:,} environments', million(n_envs, seconds(work, device))
            del env, work


def observe(device):
    """One look of 256 rays over 130 degrees: everything at full resolution, and the fused pass."""
    n_envs = 262_144 if device.type == 'cuda' else 4096
    env, _ = stepper('explorer', n_envs, device)
    scenery, agents = env.core.scenery, env.core.agents
    fused = seconds(lambda: engine.observe(scenery, agents, 4), device)
    whole = seconds(lambda: engine.render(scenery, agents), device, 5)
    yield '`render`, 256 rays, all fields', million(n_envs, whole).replace('M/s', 'M cameras/s')
    yield '`observe`, 256 rays to 64 pixels of RGB and depth', million(n_envs, fused).replace('M/s', 'M cameras/s')


def agents(device):
    """Four agents a home that see each other, lit: physics, placing, light, 512 rays to 128 pixels over 70 degrees."""
    n_envs, homes = 65_536 if device.type == 'cuda' else 1024, sample('bench', 512)
    c = core.Core(scene.scenery(homes, 4, n_envs=n_envs, device=device), res=512, fov=70)
    spawn = RandomSpawns(homes, c)
    spawn(c.agent_full(True))
    c.agents.velocity.normal_()

    def work():
        engine.physics(c.scenery, c.agents)
        engine.observe(c.scenery, c.agents, 4, imu=True, middle=True)

    yield '4 agents, 512 rays to 128 pixels, agent-frames', million(4 * n_envs, seconds(work, device))


def memory(device):
    """What one more environment takes, from the tensors that make it up."""
    sizes = []
    for n_envs in (1024, 2048):
        tree = capture.state_tree(stepper('explorer', n_envs, device)[0].env)
        sizes.append(sum(leaf.nbytes for leaf in tree.values() if isinstance(leaf, torch.Tensor)))
    yield 'memory of an Explorer environment beside the homes', f'{(sizes[1] - sizes[0]) / 1024:,.0f} bytes'


FIRST = """
import time, torch
from megastep import arrdict, envs, toys
if '{device}' != 'cpu': torch.zeros(1, device='{device}')
start = time.perf_counter()
env = envs.Explorer(64, [toys.box()], device='{device}')
env.reset()
env.step(arrdict.arrdict(actions=torch.zeros((64, 1), dtype=torch.long, device='{device}'))).reward.tolist()
print(time.perf_counter() - start)
"""


def first(device):
    """From imports, and a CUDA context, to the first step of 64 environments: with nothing kept, and again."""
    with tempfile.TemporaryDirectory() as folder:
        for what in ('cold', 'warm'):
            done = subprocess.run([sys.executable, '-c', FIRST.format(device=device)], text=True, check=True, cwd=ROOT,
                                  stdout=subprocess.PIPE, env={**os.environ, 'MEGASTEP_CACHE': folder})
            yield f'first `env.step` after import, {what} cache', f'{float(done.stdout):.2f} s'


def cpu(device):
    """The CPU backend on one and two threads, and against the brute-force twin in PyTorch on one."""
    import twin
    threads, rates = torch.get_num_threads(), {}
    for n in (1, 2):
        torch.set_num_threads(n)
        env, work = stepper('explorer', 2048, torch.device('cpu'))
        rates[n] = 2048 / seconds(work, 'cpu')
    torch.set_num_threads(1)
    yield 'CPU, Explorer, `env.step`, one thread', f'{rates[1] / 1e3:.0f} k/s'
    yield 'CPU, one to two threads', f'{rates[2] / rates[1]:.2f} times'
    scenery, agents = env.core.scenery, env.core.agents
    start, n = time.perf_counter(), 8
    for e in range(n):
        walls = scenery.designs.lines[int(scenery.design[e])]
        twin.physics(walls, agents.positions[e], agents.angles[e], agents.velocity[e], agents.angvelocity[e])
        hits = twin.cast(walls, agents.positions[e], twin.rays(agents.angles[e], [0.], 256, 130.))
        first = int(scenery.designs.wall_starts[int(scenery.design[e])])
        bounds = scenery.designs.texel_starts[first:first + len(walls) + 1].long()
        texels = scenery.designs.texels[int(bounds[0]):int(bounds[-1])]
        twin.shade(hits, texels[:, :3], bounds.diff(), texels[:, 3])
    slow = (time.perf_counter() - start) / n
    torch.set_num_threads(threads)
    yield 'CPU, Explorer, against the twin in PyTorch on one thread', f'{rates[1] * slow:.0f} times'


def train(device):
    """Training on the benchmark's homes for a minute and for four, compilation excluded, and what it evaluates to."""
    import json
    for budget in (60, 240):
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / 'run'
            subprocess.run([sys.executable, 'train.py', 'geometry=bench', f'seconds={budget}', f'folder={run}',
                            'finish.evaluate=true', f'device={device}'], check=True, cwd=ROOT, stdout=sys.stderr)
            trained, random = json.loads((run / 'evaluation.json').read_text())['rows'][:2]
            perf = [json.loads(line) for line in (run / 'perf.jsonl').read_text().splitlines()]
            rate = sorted(row['perf/rate'] for row in perf if 'perf/rate' in row)
            figure = f'{trained["return"]:.1f} ({trained["low"]:.1f} to {trained["high"]:.1f})'
            yield f'training, {budget} s, return in unseen homes', f'{figure}; random {random["return"]:.1f}'
            yield f'training, {budget} s, median rate', million(rate[len(rate) // 2], 1)


WORKS = {work.__name__: work for work in (step, observe, agents, memory, first, cpu, train)}


def commit():
    """The commit that is measured, marked if the tree differs from it."""
    def git(*words):
        return subprocess.run(['git', *words], cwd=ROOT, capture_output=True, text=True).stdout.strip()
    return (git('rev-parse', '--short', 'HEAD') or 'unknown') + ('+' if git('status', '--porcelain', '-uno') else '')


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('works', nargs='+', choices=WORKS)
    parser.add_argument('--device', default='auto')
    parser.add_argument('--commit', help='what is measured, where git cannot tell')
    parser.add_argument('--file', type=Path, help='a Markdown file to append to')
    options = parser.parse_args()
    device = engine.device(options.device)
    on = torch.cuda.get_device_name(device) if device.type == 'cuda' else 'CPU'
    tail = f'{on} | {options.commit or commit()} | {date.today()}'
    lines = ['| what | measured | on | commit | date |', '| --- | --- | --- | --- | --- |']
    print(*lines, sep='\n', flush=True)
    for name in options.works:
        for what, figure in WORKS[name](device):
            lines.append(f'| `{name}`: {what} | {figure} | {tail} |')
            print(lines[-1], flush=True)
    if options.file:
        with options.file.open('a') as file:
            print('', *lines, sep='\n', file=file)


if __name__ == '__main__':
    main()
