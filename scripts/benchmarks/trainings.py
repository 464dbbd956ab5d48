"""What the benchmarks train: each is a generator of measurements, as those of ``workloads``."""

import contextlib
import csv
import itertools
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from timing import measurement

from megastep.agents.cli import evaluate
from megastep.agents.cli.compose import Composer

ROOT = Path(__file__).resolve().parents[2]
BUDGETS = 10, 60, 240  # seconds of training
SEEDS = 1, 2, 3  # of training
CURVE = 50  # points that are kept of a run's learning curve, at most
NO_FINISH = "finish.evaluate=false", "finish.record=false"
MAZES = "geometry=maze geometry.braid=0.3"
PLACES = {"homes": "geometry=homes", "mazes": MAZES, "a box": "geometry=box"}
AGENTS = {"Explorer": "env=explorer", "PointGoal": "experiment=pointgoal"}
#: What learning curves are of.
METRICS = {"Pong": "points_won", "Explorer": "coverage", "PointGoal": "spl"}
DEATHMATCH = "experiment=deathmatch", "seconds=null", *NO_FINISH
#: What is changed of the recipe of deathmatch.
ABLATIONS = {
    "the recipe": "",
    "hits less wounds alone": "env.aim_reward=0 env.search_reward=0",
    "aim not paid": "env.aim_reward=0",
    "searching not paid": "env.search_reward=0",
    "wounds at half the cost": "env.wound_cost=0.5",
    "self-play against now alone": "opponents.past=0 opponents.bot=0",
    "past selves, no bot": "opponents.past=0.8 opponents.bot=0",
    "a drain of 0.01 per second": "env.drain=0.01",
    "fov 130": "env.fov=130",
}
N_SNAPSHOTS = 5  # of a run, that are rated
N_DUELS = 1024  # of two policies; a quarter of it of each pair that is rated
#: Learners that are compared, this one in Explorer alone.
AHEAD = "V-trace, an update behind"
LEARNERS = {
    "PPO": "learner=ppo",
    "V-trace": "learner=vtrace",
    AHEAD: "learner=vtrace learner.lag=1",
    "V-trace with replay": "learner=vtrace learner.buffer=replay learner.replay.capacity={stored}",
    "R2D2": "learner=r2d2",
}
STORED = {"cuda": 8_000_000, "cpu": 100_000}  # observations that V-trace replays
#: In what they are: overrides, what counts, and for how many seconds.
COMPARED = {
    "Explorer": ("env=explorer geometry=bench", "return", 25),
    "Pong": ("env=pong agent.core=none learner.gamma=0.99", "points_won", 12),
    "PointGoal": ("env=pointgoal geometry=homes geometry.n=2000 learner.gamma=0.99", "spl", 30),
}
#: What is trained, how, and where it is evaluated then.
RECIPES = {
    "Pong from features": ("experiment=pong", {"": ""}),
    "Pong from pictures": ("experiment=pong_pixels", {"": ""}),
    "Pong, self-play": (
        "experiment=pong env.self_play=true seconds=25",
        {"court of the tracker": "env=pong"},
    ),
    **{
        f"{name}, trained in {place}": (f"{how} {PLACES[place]} geometry.n=2000 seconds=60", PLACES)
        for name, how in AGENTS.items()
        for place in ("homes", "mazes")
    },
}


def train(device, seeds=SEEDS, budgets=BUDGETS):
    """Training on the benchmark's homes for 10, 60 and 240 seconds, without compilation, three
    seeds each, and what that evaluates to in unseen homes.
    """
    for budget, seed in itertools.product(budgets, seeds):
        what = f"training, {budget} s, seed {seed}"
        given = "geometry=bench", f"seconds={budget}", f"seed={seed}", "finish.evaluate=true"
        with trained(device, *given) as run:
            (written,) = run.glob("evaluations/*.json")
            rows = json.loads(written.read_text())["rows"][:2]
            reports = curve(run)
        for whose, row in zip(("return", "return of random actions"), rows):
            yield mean(f"{what}, {whose} in unseen homes", row, row["return"])
        if len(reports) > 1:
            yield learnt(what, reports)


def learnt(what, reports):
    """The rate of a run, with its learning curve, thinned, from what :func:`curve` gives."""
    rates = [
        (samples - before) / (seconds - earlier) / 1e6
        for (earlier, before, _), (seconds, samples, _) in itertools.pairwise(reports)
    ]
    thinned = [
        [round(seconds, 2), samples, round(earned, 3)]
        for seconds, samples, earned in reports[:: -(-len(reports) // CURVE)]
    ]
    return measurement(f"{what}, median rate", "M/s", rates) | dict(curve=thinned)


@contextlib.contextmanager
def trained(device, *overrides):
    """A run folder, for as long as the context lasts."""
    with side_by_side(device, overrides) as (run,):
        yield run


@contextlib.contextmanager
def side_by_side(device, *runs):
    """The folders of runs that train at the same time, each of overrides, for as long as the
    context lasts.
    """
    with tempfile.TemporaryDirectory() as parent:
        folders = [Path(parent) / f"run{i}" for i in range(len(runs))]
        commands = [
            [sys.executable, "train.py", *overrides, f"folder={folder}", f"device={device}"]
            for overrides, folder in zip(runs, folders)
        ]
        processes = [
            subprocess.Popen(command, cwd=ROOT, stdout=sys.stderr, stderr=sys.stderr)
            for command in commands
        ]
        try:
            for process, command in zip(processes, commands):
                if process.wait():
                    raise subprocess.CalledProcessError(process.returncode, command)
        finally:
            for process in processes:
                process.terminate()
                process.wait()
        yield folders


def worlds(device):
    """Each world's recipe, one seed: what an agent earns in first episodes, in unseen places, and
    random actions beside it.
    """
    for what, (recipe, places) in RECIPES.items():
        with trained(device, *recipe.split(), *NO_FINISH) as run:
            reports = curve(run, METRICS[what.split(",")[0].split()[0]])
            seconds, samples, _ = reports[-1]
            yield learnt(what, reports)
            for place, given in places.items():
                told = f"{what}, {seconds:.0f} s, {samples / 1e6:.0f} M samples"
                told += f", in {place}" if place else ""
                for row in evaluated(run, device, *given.split()):
                    for name in ("return", *row["metrics"]):
                        yield metric(f"{told}: {name}, {row['agent']}", row, name)


def duels(device, seeds=SEEDS, samples=600_000_000):
    """The recipe of Deathmatch, seeds side by side on one device: the share of duels that each wins
    on unseen homes, a draw being half, and ratings of its snapshots and the scripted bot.
    """
    runs = [
        (*DEATHMATCH, f"samples={samples}", f"seed={seed}", f"snapshots={N_SNAPSHOTS}")
        for seed in seeds
    ]
    with side_by_side(device, *runs) as folders:
        for seed, run in zip(seeds, folders):
            what = f"deathmatch, {samples / 1e6:.0f} M samples, seed {seed}"
            yield learnt(what, curve(run, "accuracy"))
            yield from won(what, run, device, "bot", "random")
            rated = written_by_evaluate(
                run, device, "ratings=true", "against=[bot]", f"episodes={N_DUELS // 4}"
            )
            rows = list(csv.DictReader(rated.read_text().splitlines()))
            for row in rows:
                rating, spread = float(row["rating"]), 2 * float(row["sigma"])
                yield dict(
                    what=f"{what}, rating of {row['player'].rpartition(':')[2]}",
                    value=rating,
                    unit="",
                    lower=rating - spread,
                    upper=rating + spread,
                    n=int(row["duels"]),
                )


def ablation(device, samples=60_000_000):
    """The recipe of Deathmatch with one thing changed, all side by side on one device, one seed:
    the share of duels that each wins on unseen homes, a draw being half.
    """
    runs = [(*DEATHMATCH, f"samples={samples}", *given.split()) for given in ABLATIONS.values()]
    with side_by_side(device, *runs) as folders:
        for name, run in zip(ABLATIONS, folders):
            what = f"deathmatch, {samples / 1e6:.0f} M samples, {name}"
            yield from won(what, run, device, "bot", "random")


def learners(device, seeds=SEEDS, budgets=None, worlds=tuple(COMPARED)):
    """Learners compared, each by itself on the device for as many seconds: three seeds of Explorer,
    the first alone of other worlds and of acting an update behind. What counts there, evaluated in
    unseen homes, with the learning curve.
    """
    for world in worlds:
        how, counted, own = COMPARED[world]
        several = seeds if world == "Explorer" else seeds[:1]
        for seed, budget in itertools.product(several, budgets or [own]):
            for name, given in LEARNERS.items():
                if name == AHEAD and (world != "Explorer" or seed != seeds[0]):
                    continue
                what = f"{world}, {name}, {budget} s, seed {seed}"
                given = given.format(stored=STORED[device.type])
                words = f"log_every=10 {how} {given} seconds={budget} seed={seed}".split()
                with trained(device, *words, *NO_FINISH) as run:
                    reports = curve(run, counted)
                    row = evaluated(run, device)[0]
                if len(reports) > 1:
                    yield learnt(what, reports)
                where = "in unseen homes" if row["homes"] else "in first episodes"
                yield metric(f"{what}: {counted} {where}", row, counted)


def won(what, run, device, *opponents):
    """Measurements of a run's duels against each."""
    for row in evaluated(run, device, f"against=[{','.join(opponents)}]", f"episodes={N_DUELS}"):
        told = f"{row['wins']} won, {row['draws']} drawn, {row['losses']} lost"
        told = f"{what}: duels against {row['against'].rpartition(':')[2]} ({told})"
        yield mean(told, row, row["won"])


def mean(what, row, value):
    """A mean of a row of evaluate.py's table, with its interval over homes, or lanes where there
    are none.
    """
    bounds = {key: row[key] for key in ("lower", "upper")}
    return dict(what=what, value=value, unit="", **bounds, n=row["homes"] or row["lanes"])


def metric(what, row, name):
    """A metric of such a row, or its return."""
    if name == "return":
        return mean(what, row, row["return"])
    found = row["metrics"][name]
    return mean(what, {**row, **found}, found["mean"])


def evaluated(run, device, *overrides):
    """The rows of the table that evaluate.py gives."""
    return json.loads(written_by_evaluate(run, device, *overrides).read_text())["rows"]


def written_by_evaluate(run, device, *overrides):
    """The file that evaluate.py writes."""
    settings = Composer(evaluate.SCRIPT).settings([f"run={run}", f"device={device}", *overrides])
    with contextlib.redirect_stdout(sys.stderr):
        return evaluate.run(settings)


def curve(run, metric="return"):
    """[(seconds, samples, metric), ...]: what a run folder's reports say of the episodes that ended
    while it trained.
    """
    metrics, perf = (
        {row["samples"]: row for row in map(json.loads, (run / name).read_text().splitlines())}
        for name in ("metrics.jsonl", "perf.jsonl")
    )
    return [
        (perf[samples]["perf/seconds"], samples, row[f"episode/{metric}"])
        for samples, row in metrics.items()
        if samples in perf and f"episode/{metric}" in row
    ]
