"""What the benchmarks train: each is a generator of measurements, as those of ``workloads``."""

import contextlib
import itertools
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from timing import measurement

from agents.cli import evaluate
from agents.cli.build import build
from agents.cli.compose import ConfigLoader
from agents.cli.settings import Evaluate

ROOT = Path(__file__).resolve().parents[1]
BUDGETS = 10, 60, 240  # seconds of training
SEEDS = 1, 2, 3  # of training
CURVE = 50  # points that are kept of a run's learning curve, at most
NO_FINISH = "finish.evaluate=false", "finish.record=false"
MAZES = "geometry=maze geometry.braid=0.3"
PLACES = {"homes": "geometry=homes", "mazes": MAZES, "a box": "geometry=box"}
AGENTS = {"Explorer": "env=explorer", "PointGoal": "experiment=pointgoal"}
#: What learning curves are of.
METRICS = {"Pong": "points_won", "Explorer": "coverage", "PointGoal": "spl"}
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
            yield dict(
                what=f"{what}, {whose} in unseen homes",
                value=row["return"],
                unit="",
                lower=row["lower"],
                upper=row["upper"],
                n=row["homes"],
            )
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
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        command = [sys.executable, "train.py", *overrides, f"folder={run}", f"device={device}"]
        subprocess.run(command, check=True, cwd=ROOT, stdout=sys.stderr)
        yield run


HOMES_N, MAZES_N = (
    "geometry=homes geometry.n=2000",
    "geometry=maze geometry.n=2000 geometry.braid=0.3",
)
PLACES = {
    "homes": "geometry=homes",
    "mazes": "geometry=maze geometry.braid=0.3",
    "a box": "geometry=box",
}


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
                for row in evaluated(run, f"{given} device={device}".split()):
                    values = {"return": dict(mean=row["return"], **row), **row["metrics"]}
                    for name, value in values.items():
                        yield dict(
                            what=f"{told}: {name}, {row['agent']}",
                            value=value["mean"],
                            unit="",
                            lower=value["lower"],
                            upper=value["upper"],
                            n=row["homes"] or row["lanes"],
                        )


def evaluated(run, overrides):
    """The rows of the table that evaluate.py gives."""
    with ConfigLoader("evaluate", Evaluate) as loader:
        settings = build(Evaluate, loader.tree([f"run={run}", *overrides]))
    with contextlib.redirect_stdout(sys.stderr):
        return json.loads(evaluate.run(settings).read_text())["rows"]


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
