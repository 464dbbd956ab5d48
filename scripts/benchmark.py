"""Measures what docs/benchmarks.md says, and writes it there.

    python scripts/benchmark.py step kernels --json docs/benchmarks.jsonl   # prints a table,
    appends a line a figure python scripts/benchmark.py report
    # docs/benchmarks.jsonl to table and plot

Works: step, kernels, counters, observe, agents, memory, compile, first, cpu, train. All run in the
benchmark's homes, with random actions drawn beforehand on the device. A figure is the median of its
samples, its spread their 10th and 90th percentile. A sample is the mean of as many calls as fill 50
ms after warming up, timed by CUDA events on a GPU and by the clock on the CPU.
"""

import argparse
import difflib
import itertools
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path
from unittest import mock

os.environ.setdefault(
    "OMP_WAIT_POLICY", "passive"
)  # before torch, which would have idle threads spin

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "scripts")]

from counters import counters  # noqa: E402

from megastep import arrdict, capture, core, engine, envs, modules, scene  # noqa: E402
from megastep.geometries import sample  # noqa: E402

SIZES = {"cuda": (1024, 2048, 4096, 8192, 16_384, 65_536, 262_144, 1_048_576), "cpu": (1024, 8192)}
KERNEL_SIZES = {"cuda": (8192, 262_144), "cpu": (2048,)}
HOMES = 512
WARM_UP = 60  # steps, so that agents are not where they spawned
REPEATS = 15  # samples of a figure
SECONDS = 0.05  # of a sample
FRESH = 3  # samples of what takes a process each
BUDGETS = 60, 240  # seconds of training
TURNS = 16  # random actions that are taken in turn, and operations in one CUDA graph
SCALES = {"k": 1e3, "M": 1e6}


# ---- Timing ----


def laps(work, device, calls, n):
    """Seconds that each of ``n`` laps of ``calls`` calls takes."""
    gpu = device.type == "cuda"

    def mark():
        if not gpu:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    marks = [mark()]
    for _ in range(n):
        for _ in range(calls):
            work()
        marks.append(mark())
    if gpu:
        torch.cuda.synchronize(device)
    return [
        start.elapsed_time(end) / 1e3 if gpu else end - start
        for start, end in zip(marks, marks[1:])
    ]


def timed(work, device, repeats=None):
    """Seconds of a call of ``work``, a list of samples."""
    calls = max(1, round(SECONDS / min(laps(work, device, 1, 3))))
    return [lap / calls for lap in laps(work, device, calls, repeats or REPEATS)]


def alone(function, device):
    """Seconds of a call of ``function(i)``, i in turn from 0 to 15, by itself: on a GPU the sixteen
    are one CUDA graph, so that none waits for Python.
    """
    if device.type != "cuda":
        turn = itertools.cycle(range(TURNS))
        return timed(lambda: function(next(turn)), device)

    def turns():
        for i in range(TURNS):
            function(i)

    return [lap / TURNS for lap in timed(capture.capture(turns, (), ()), device)]


def figure(what, unit, samples):
    """A figure: the median of ``samples`` and, of several, their 10th and 90th percentile."""
    low, *_, high = (
        statistics.quantiles(samples, n=10, method="inclusive")
        if len(samples) > 1
        else [None, None]
    )
    return dict(
        what=what, value=statistics.median(samples), unit=unit, low=low, high=high, n=len(samples)
    )


def rate(what, count, times, unit="M/s"):
    """The figure of ``count`` things done in each of ``times`` seconds; ``unit`` begins with its
    scale.
    """
    return figure(what, unit, [count / t / SCALES[unit[0]] for t in times])


# ---- What is timed ----

FOUND = {}  # id of a home -> the home, its spawn points


def searched_once():
    """Within it a home's spawn points are searched for once: 512 homes take seconds, and all sizes
    have the same.
    """
    search = modules._spawn_points

    def recalled(home, *how):
        if id(home) not in FOUND:
            FOUND[id(home)] = home, search(home, *how)
        return FOUND[id(home)][1]

    return mock.patch.object(modules, "_spawn_points", recalled)


def random_actions(n_envs, n_agents, device, turns=TURNS):
    return [
        arrdict.arrdict(actions=torch.randint(7, (n_envs, n_agents), device=device))
        for _ in range(turns)
    ]


def stepper(name, n_envs, device, turns=TURNS):
    """An environment that has been walked about in, and a function that takes its next step,
    captured on a GPU.
    """
    with searched_once():
        env = capture.Captured(envs.ENVS[name](n_envs, sample("bench", HOMES), device=device))
    actions = itertools.cycle(random_actions(n_envs, 1, device, turns))
    env.reset()
    for _ in range(WARM_UP):
        env.step(next(actions))
    return env, lambda: env.step(next(actions))


def four_agents(n_envs, device):
    """A core of four agents a home, 512 rays over 70 degrees, that have walked about, and a
    function that moves them by the i-th actions.
    """
    homes = sample("bench", HOMES)
    c = core.Core(scene.scenery(homes, 4, n_envs=n_envs, device=device), res=512, fov=70)
    with searched_once():
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
    draws = modules.RandomStream(n, 1, device)
    yield "`physics`", lambda i: env.movement(actions[i])
    yield "`spawn` of 1 in 256", lambda i: env.spawner(some)
    yield "`draw` of 1 in 256", lambda i: draws(some)
    yield (
        "`observe` as Explorer does, 256 rays to 64 pixels",
        lambda i: engine.observe(scenery, seers, 4, imu=True, seen=env.seen, clear_mask=some),
    )
    yield "`render`, 256 rays, all fields", lambda i: engine.render(scenery, seers)
    minimal, _ = stepper("minimal", n, device)
    yield (
        "`observe` as Minimal does, RGB of 64 rays",
        lambda i: engine.observe(minimal.core.scenery, minimal.core.agents, depth=False),
    )
    c, _ = four_agents(n // 4, device)
    yield "`place`, lit, 4 a home", lambda i: engine.update_agent_geometry(c.scenery, c.agents)


# ---- The works: generators of figures ----


def step(device):
    """`env.step` of whole environments, everything they do included; frames a second."""
    for name in ("explorer", "minimal"):
        for n_envs in SIZES[device.type]:
            times = timed(stepper(name, n_envs, device)[1], device)
            yield rate(f"{name}, `env.step`, {n_envs:,} environments", n_envs, times)


def kernels(device):
    """Each operation alone; on a GPU sixteen in one CUDA graph."""
    for n in KERNEL_SIZES[device.type]:
        for what, function in operations(n, device):
            yield figure(
                f"{what}, {n:,} agents",
                "ns an agent",
                [t / n * 1e9 for t in alone(function, device)],
            )


def observe(device):
    """One look of 256 rays over 130 degrees: everything at full resolution, and the fused pass."""
    n_envs = KERNEL_SIZES[device.type][-1]
    env, _ = stepper("explorer", n_envs, device)
    scenery, seers = env.core.scenery, env.core.agents
    whole = alone(lambda i: engine.render(scenery, seers), device)
    fused = alone(lambda i: engine.observe(scenery, seers, 4), device)
    yield rate("`render`, 256 rays, all fields", n_envs, whole, "M cameras/s")
    yield rate("`observe`, 256 rays to 64 pixels of RGB and depth", n_envs, fused, "M cameras/s")


def agents(device):
    """Four agents a home that see each other, lit: physics, placing, light, 512 rays to 128 pixels
    over 70 degrees.
    """
    n_envs = 65_536 if device.type == "cuda" else 1024
    c, move = four_agents(n_envs, device)

    def work(i):
        move(i)
        engine.observe(c.scenery, c.agents, 4, imu=True, middle=True)

    yield rate("4 agents, 512 rays to 128 pixels, agent-frames", 4 * n_envs, alone(work, device))


def memory(device):
    """What one more environment takes, from the tensors that make it up; on a GPU also the most
    that was allocated while the largest number of environments was made and walked about in.
    """
    sizes = []
    for n_envs in (1024, 2048):
        tree = capture.state_tree(stepper("explorer", n_envs, device)[0].env)
        sizes.append(sum(leaf.nbytes for leaf in tree.values() if isinstance(leaf, torch.Tensor)))
    yield figure(
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
        yield figure(
            f"explorer, {n_envs:,} environments, most memory allocated", "GB", [peak / 1e9]
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
compile.cuda(device.index or 0) if device.type == 'cuda' else compile.cpu()
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
env.step(arrdict.arrdict(actions=torch.zeros((64, 1), dtype=torch.long,
device=device))).reward.tolist() print(time.perf_counter() - start)
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


def compile(device):
    """The kernels built with nothing kept: by NVRTC for a GPU, by the C++ compiler for the CPU."""
    yield figure(
        "build of all kernels, cold cache",
        "s",
        [fresh(BUILD, device, 1)[0] for _ in range(FRESH)],
    )


def first(device):
    """From imports, and a CUDA context, to the first step of 64 environments: with nothing kept,
    and again.
    """
    pairs = [fresh(FIRST, device, 2) for _ in range(FRESH)]
    for what, times in zip(("cold", "warm"), zip(*pairs)):
        yield figure(f"first `env.step` after import, {what} cache", "s", times)


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
        world = itertools.cycle(range(8))
        slow = timed(lambda: twin_frame(env.core, next(world)), device, 8)
    finally:
        torch.set_num_threads(threads)
    yield rate("CPU, Explorer, `env.step`, one thread", n_envs, times[1], "k/s")
    yield figure(
        "CPU, one to two threads", "times", [one / two for one, two in zip(times[1], times[2])]
    )
    yield figure(
        "CPU, Explorer, against the twin in PyTorch on one thread",
        "times",
        [t * n_envs / one for t, one in zip(slow, times[1])],
    )


def twin_frame(c, e):
    """What a frame of world ``e`` takes the twin: physics, rays, shading."""
    import twin

    layouts, seers, d = c.scenery.layouts, c.agents, int(c.scenery.layout[e])
    walls, first_wall = layouts.lines[d], int(layouts.wall_starts[d])
    twin.physics(
        walls, seers.positions[e], seers.angles[e], seers.velocity[e], seers.angvelocity[e]
    )
    hits = twin.cast(walls, seers.positions[e], twin.rays(seers.angles[e], [0.0], 256, 130.0))
    bounds = layouts.texel_starts[first_wall : first_wall + len(walls) + 1].long()
    texels = layouts.texels[int(bounds[0]) : int(bounds[-1])]
    twin.shade(hits, texels[:, :3], bounds.diff(), texels[:, 3])


def train(device):
    """Training on the benchmark's homes for a minute and for four, without compilation, and what
    that evaluates to.
    """
    for budget in BUDGETS:
        with tempfile.TemporaryDirectory() as folder:
            run = Path(folder) / "run"
            subprocess.run(
                [
                    sys.executable,
                    "train.py",
                    "geometry=bench",
                    f"seconds={budget}",
                    f"folder={run}",
                    "finish.evaluate=true",
                    f"device={device}",
                ],
                check=True,
                cwd=ROOT,
                stdout=sys.stderr,
            )
            rows = json.loads((run / "evaluation.json").read_text())["rows"][:2]
            perf = [json.loads(line) for line in (run / "perf.jsonl").read_text().splitlines()]
        for whose, row in zip(("return", "return of random actions"), rows):
            yield dict(
                what=f"training, {budget} s, {whose} in unseen homes",
                value=row["return"],
                unit="",
                low=row["low"],
                high=row["high"],
                n=row["homes"],
            )
        yield figure(
            f"training, {budget} s, median rate",
            "M/s",
            [row["perf/rate"] / 1e6 for row in perf if "perf/rate" in row],
        )


WORKS = {
    work.__name__: work
    for work in (step, kernels, counters, observe, agents, memory, compile, first, cpu, train)
}


# ---- Records ----


def said(*words):
    """What a command prints, or nothing if it is not there or fails."""
    try:
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
        return "" if done.returncode else done.stdout.strip()
    except OSError:
        return ""


def commit():
    """The commit that is measured, marked if the tree, docs apart, differs from it."""
    return (said("git", "rev-parse", "--short", "HEAD") or "unknown") + (
        "+" if said("git", "status", "--porcelain", "-uno", "--", ".", ":!docs") else ""
    )


def machine(device):
    """What a record says of where it was measured."""
    if device.type == "cuda":
        driver = said(
            "nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"
        ).partition("\n")[0]
        on, cuda = torch.cuda.get_device_name(device), torch.version.cuda
    else:
        info = Path("/proc/cpuinfo")
        names = re.findall(r"model name\s*: (.*)", info.read_text() if info.exists() else "") or [
            "unknown"
        ]
        on, driver, cuda = (
            f"CPU, {torch.get_num_threads()} threads of {names[0].strip()}",
            None,
            None,
        )
    return dict(
        on=on, driver="unknown" if driver == "" else driver, torch=torch.__version__, cuda=cuda
    )


def measure(name, device, commit):
    """The records of a work, as they come."""
    device = torch.device("cpu") if name == "cpu" else device
    command = f"python scripts/benchmark.py {name}" + (
        "" if device.type == "cuda" else " --device cpu"
    )
    where = machine(device)
    for found in WORKS[name](device):
        numbers = {key: rounded(found[key]) for key in ("value", "low", "high")}
        yield dict(
            work=name,
            **{**found, **numbers},
            **where,
            commit=commit,
            date=str(date.today()),
            command=command,
        )


def rounded(number):
    return None if number is None else float(f"{number:.6g}")


def text(number):
    """A number as a table shows it."""
    return f"{number:,.0f}" if abs(number) >= 1000 else f"{number:.4g}"


HEADER = "| work | what | median | 10 % to 90 % | n | on | commit | date |\n" + 8 * "| --- " + "|"


def row(record):
    """A record as a line of the table."""
    spread = "" if record["low"] is None else f"{text(record['low'])} to {text(record['high'])}"
    names = [("driver", record["driver"]), ("torch", record["torch"])]
    on = ", ".join([record["on"], *(f"{name} {version}" for name, version in names if version)])
    value = f"{text(record['value'])} {record['unit']}".strip()
    cells = [
        f"`{record['work']}`",
        record["what"],
        value,
        spread,
        record["n"] or "",
        on,
        record["commit"],
        record["date"],
    ]
    return "| " + " | ".join(map(str, cells)) + " |"


# ---- The report ----

MARKS = "<!-- figures: written by scripts/benchmark.py report -->", "<!-- end of figures -->"
ORIGINAL = 16_384, 0.86e6  # environments and frames a second of the original's Explorer on one H200
COLOURS = {"explorer": "tab:blue", "minimal": "tab:orange"}
LEGEND = """Median and spread of n samples. A sample is the mean over as many calls as fill 50 ms
after warming up, timed by CUDA events on a GPU; or one process; or one report of a training run. A
return is a mean over n homes with its 95 % interval. Without a spread: counted, or read once by
Nsight Compute. `python scripts/benchmark.py WORK --json docs/benchmarks.jsonl` measures, on the CPU
with `--device cpu`; `python scripts/benchmark.py report` writes this. The works:"""


def newest(records):
    """The newest record of each figure on each GPU and on the CPU, in order of work, place and
    name.
    """
    found = {}
    for record in sorted(records, key=lambda record: record["date"]):
        kind = "CPU" if record["on"].startswith("CPU") else record["on"]
        found[record["work"], kind, record["what"]] = record

    def order(key):
        work, kind, what = key
        parts = re.split(r"(\d[\d,]*)", what)
        numbers = [int(part.replace(",", "")) for part in parts[1::2]]
        return list(WORKS).index(work), kind == "CPU", kind, parts[::2], numbers

    return [found[key] for key in sorted(found, key=order)]


def rewritten(page, records, plot):
    """``page`` with the table of ``records`` and the picture ``plot`` between its marks."""
    before, start, rest = page.partition(MARKS[0])
    _, end, after = rest.partition(MARKS[1])
    if not (start and end):
        raise ValueError(
            f"the page needs the lines {MARKS[0]} and {MARKS[1]}, for the figures to stand between."
        )
    works = [f"- `{name}`: {' '.join(work.__doc__.split())}" for name, work in WORKS.items()]
    picture = f"![Frames a second against environments, both logarithmic]({plot})"
    middle = [
        start,
        picture,
        LEGEND,
        "\n".join(works),
        "\n".join([HEADER, *map(row, newest(records))]),
        end,
    ]
    return before + "\n\n".join(middle) + after


def draw(records, path):
    """Frames a second against environments, log-log, as an SVG that is the same for the same
    records.
    """
    import matplotlib
    from matplotlib.figure import Figure

    series = {}
    for record in newest(records):
        match = re.fullmatch(r"(\w+), `env.step`, ([\d,]+) environments", record["what"])
        if record["work"] == "step" and match:
            ends = [record[key] or record["value"] for key in ("value", "low", "high")]
            point = int(match[2].replace(",", "")), *(1e6 * end for end in ends)
            series.setdefault((match[1], record["on"]), []).append(point)
    ax = Figure(figsize=(7.5, 4.8), layout="constrained").subplots()
    for (name, on), points in series.items():
        n, value, low, high = zip(*sorted(points))
        style = dict(color=COLOURS.get(name), linestyle="--" if on.startswith("CPU") else "-")
        ax.plot(n, value, marker="o", markersize=4, label=f"{name}, {on}", **style)
        ax.fill_between(n, low, high, color=style["color"], alpha=0.2, linewidth=0)
    ax.plot(*ORIGINAL, "kx", label="the original's Explorer, one H200", linestyle="none")
    ax.set(xscale="log", yscale="log", xlabel="environments", ylabel="frames a second")
    ticks = [2**k for k in range(10, 21, 2)]
    ax.set_xticks(ticks, [f"{tick:,}" for tick in ticks])
    ax.minorticks_off()
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "megastep"}):
        ax.figure.savefig(path, metadata={"Date": None})


def read(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def report(path):
    """Rewrites the page, and draws the plot, that lie beside the records of ``path`` under the same
    name.
    """
    records, page, plot = read(path), path.with_suffix(".md"), path.with_suffix(".svg")
    page.write_text(rewritten(page.read_text(), records, plot.name))
    draw(records, plot)


# ---- The command line ----


def checked(options):
    """The device to measure on. ValueError or EngineError, one sentence, for what cannot be
    measured.
    """
    for name in options.works:
        if name not in WORKS:
            near = difflib.get_close_matches(name, [*WORKS, "report"], 1, 0)[0]
            raise ValueError(
                f"there is no work {name!r}; did you mean {near!r}? There are {', '.join(WORKS)}, "
                f"and "
                f"report, which stands alone."
            )
    device = engine.device(options.device)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    return device


def main(argv=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "works", nargs="+", metavar="WORK", help=f"{', '.join(WORKS)}, or report alone"
    )
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1")
    parser.add_argument("--commit", help="what is measured, where git cannot tell")
    parser.add_argument(
        "--json", type=Path, help="a file to append records to; report reads docs/benchmarks.jsonl"
    )
    try:
        run(parser.parse_args(argv))
    except (ValueError, OSError, engine.EngineError) as error:
        print(f"benchmark.py: {error}", file=sys.stderr)
        return 2
    return 0


def run(options):
    if options.works == ["report"]:
        return report(options.json or ROOT / "docs" / "benchmarks.jsonl")
    device, measured = checked(options), options.commit or commit()
    print(HEADER, flush=True)
    for name in options.works:
        for record in measure(name, device, measured):
            print(row(record), flush=True)
            if options.json:
                with options.json.open("a") as file:
                    print(json.dumps(record), file=file)


if __name__ == "__main__":
    sys.exit(main())
