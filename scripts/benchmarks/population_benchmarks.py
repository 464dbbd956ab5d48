"""Benchmarks of populations: `members`, `small_members`, `copies`, `search`, `memory_search` and
`league`.

Options: `--seconds` of training per run; `--seeds`; `--folder` keeps the run folders, and those
that are there already are not trained again.
"""

import contextlib
import functools
import itertools
import math
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from paths import ROOT
from timing import measurement, seconds_per_call
from training_runs import metric_mean, newest_evaluation, rates, share_of_duels_won

from megastep.agents.cli.compose import Composer
from megastep.agents.cli.scripts import TRAIN
from megastep.agents.factory.trainer import make_trainer
from megastep.agents.runs import populations

NO_FINISH = "finish.evaluate=false", "finish.record=false"
RATED = "env=explorer", "geometry=bench", "agent.width=128"
#: (members, lanes of each, lanes of the run beside them)
MEMBERS = {"cuda": (8, 4096, 4096), "cpu": (2, 64, 64)}
SMALL_MEMBERS = {"cuda": (64, 256, 16384), "cpu": (4, 16, 64)}
#: Settings of a search, spread tenfold.
VARY = (
    "population.vary={learner.lr: {min: 3e-4, max: 3e-3, log: true}, "
    "learner.entropy_coef: {min: 3e-3, max: 3e-2, log: true}}"
)
N_MEMBERS = {"cuda": 8, "cpu": 4}
#: Samples of each member from one generation to the next.
EVERY = {"cuda": 20_000_000, "cpu": 5_000}
EXPLORER, MEMORY = ("env=explorer", "geometry=bench"), ("experiment=memory_9",)
DEATHMATCH = ("experiment=deathmatch",)
LEAGUE = (
    "opponents.league=0.5",
    "opponents.past=0.2",
    "opponents.bot=0.1",
    "opponents.snapshots=4",  # and as many rivals, each of which is launched on its own
    "population.score=won/league",
)
OPPONENTS = "opponents.snapshots=8", "opponents.every=200"
#: Environments of each member: as many updates per second as the single run has with 8,192.
LEAGUE_ENVS = {"cuda": 1024, "cpu": 64}
EPISODES = {"cuda": 1024, "cpu": 64}
#: Duels of each pair: the interval of a share is then 0.015 on either side.
DUELS = {"cuda": 4096, "cpu": 64}
NEVER = 10**15  # samples: no generation


def members(device: torch.device, seconds: int = 30) -> Iterator[dict]:
    """Training of Explorer with an LSTM of 128 units: samples per second of 8 members in sum with
    4,096 lanes each, and of one run with 4,096 lanes.
    """
    yield from _rates(device, seconds, *MEMBERS[device.type])


def small_members(device: torch.device, seconds: int = 30) -> Iterator[dict]:
    """The same of 64 members with 256 lanes each, and of one run with 16,384 lanes."""
    yield from _rates(device, seconds, *SMALL_MEMBERS[device.type])


def copies(device: torch.device) -> Iterator[dict]:
    """Milliseconds in which a member takes over what another has learnt: weights, optimizer and
    statistics, of Explorer's policies with LSTMs of 128 and 256 units.
    """
    for width in (128, 256):
        trainers = []
        with _parent(None) as parent:
            for name in ("source", "target"):
                words = "env=explorer", "env.n_envs=64", f"agent.width={width}", f"device={device}"
                cfg = Composer(TRAIN).settings([*words, "samples=1e12"])
                (parent / name).mkdir()
                trainer = make_trainer(cfg, parent / name, device)
                trainer.rollout = trainer.collect()
                trainer.update()  # the optimizer has a state from here on
                trainers.append(trainer)
            source, target = (trainer.learner for trainer in trainers)
            copy = functools.partial(target.copy_from, source)
            seconds = seconds_per_call(copy, device)
            for trainer in trainers:
                trainer.close()
        what = f"Explorer, LSTM-{width}, a member takes over from another"
        yield measurement(what, "ms", [1e3 * one for one in seconds])


def search(
    device: torch.device,
    seconds: int = 120,
    seeds: Sequence[int] = (1, 2, 3),
    folder: Path | None = None,
) -> Iterator[dict]:
    """Explorer's return in unseen homes of the best of 8 members, which copy each other, and of the
    best of the same 8 that never do: settings drawn at random, in the same wall time.
    """
    yield from _search(device, "Explorer", EXPLORER, seconds, seeds, folder)


def memory_search(
    device: torch.device,
    seconds: int = 120,
    seeds: Sequence[int] = (1,),
    folder: Path | None = None,
) -> Iterator[dict]:
    """The same in Memory's mazes of 9 x 9 cells, one seed."""
    yield from _search(device, "Memory 9x9", MEMORY, seconds, seeds, folder)


def league(
    device: torch.device,
    seconds: int = 600,
    seeds: Sequence[int] = (1,),
    folder: Path | None = None,
) -> Iterator[dict]:
    """Deathmatch: the best of a league of 8, which have fewer environments each and are ranked by
    the duels that they win, against a single run of the same wall time, and each of the two against
    the hunter: duels in unseen homes, a draw being half; and of those that were decided, the share
    that was won, with its 95 % interval (Wilson).
    """
    n = N_MEMBERS[device.type]
    with _parent(folder) as parent:
        for seed in seeds:
            words = (*DEATHMATCH, *OPPONENTS, f"seed={seed}")
            size = f"population.size={n}", VARY, f"population.every={EVERY[device.type]}"
            single = _trained(parent, f"single-{seed}", device, seconds, *words)
            size = *size, f"env.n_envs={LEAGUE_ENVS[device.type]}"
            group = _trained(parent, f"league-{seed}", device, seconds, *words, *LEAGUE, *size)
            best = populations.member(group)
            title = f"deathmatch, {seconds} s, seed {seed}"
            for name, run, others in (
                (f"best of a league of {n} ranked by duels", best, [single, "hunter"]),
                ("single run", single, ["hunter"]),
            ):
                opponents = f"against=[{','.join(map(str, others))}]"
                rows = _evaluated(run, device, opponents, episodes=DUELS[device.type])
                for other, row in zip(others, rows):
                    row["against"] = "the single run" if other is single else "the hunter"
                    what = f"{title}, {name}"
                    yield share_of_duels_won(what, row)
                    yield _decided(f"{what}: decided duels against {row['against']}", row)


def _rates(device, seconds, n, n_lanes, n_lanes_of_one) -> Iterator[dict]:
    """Measures a population and a run beside it, and what the one has of the other."""
    medians = []
    for count, lanes in ((1, n_lanes_of_one), (n, n_lanes)):
        words = *RATED, f"env.n_envs={lanes}", f"population.size={count}", "population.every=1e15"
        with _parent(None) as parent:
            run = _trained(parent, "run", device, seconds, *words)
            # all do the same updates, and the first one's clock is that of all
            found = [count * r / 1e6 for r in rates(run if count == 1 else run / "member-0")]
        found = found[1:] or found
        medians.append(statistics.median(found))
        whose = "one run" if count == 1 else f"{count} members in sum"
        yield measurement(f"Explorer, LSTM-128, {whose}, {lanes:,} lanes each", "M/s", found)
    share = 100 * medians[1] / medians[0]
    what = f"Explorer, LSTM-128, {n} members of {n_lanes:,} lanes, of one run of {n_lanes_of_one:,}"
    yield measurement(what, "%", [share])


def _search(device, title, words, seconds, seeds, folder) -> Iterator[dict]:
    n = N_MEMBERS[device.type]
    kinds = {f"PBT over {n}": EVERY[device.type], f"best of {n} drawn at random": NEVER}
    with _parent(folder) as parent:
        for seed, (kind, every) in itertools.product(seeds, kinds.items()):
            size = f"population.size={n}", VARY, f"population.every={every}", f"seed={seed}"
            name = f"{title}-{kind}-{seed}".replace(" ", "-")
            run = _trained(parent, name, device, seconds, *words, *size)
            best = populations.member(run)
            row = _evaluated(best, device, "baseline=none")[0]
            what = f"{title}, {seconds} s, seed {seed}, {kind}"
            yield metric_mean(f"{what}: return of the best, in unseen homes", row, "return")
            n_generations = len(populations.read(run / populations.FILE)) - 1
            yield measurement(f"{what}: generations", "", [n_generations])


def _decided(what, row) -> dict:
    """Measures the share of decided duels that were won, with Wilson's 95 % interval."""
    wins, n = row["wins"], row["wins"] + row["losses"]
    if not n:
        return dict(what=what, value=0.5, unit="", lower=0.0, upper=1.0, n=0)
    z, share = 1.96, wins / n
    centre, scale = share + z * z / (2 * n), 1 + z * z / n
    reach = z * math.sqrt(share * (1 - share) / n + z * z / (4 * n * n))
    bounds = dict(lower=(centre - reach) / scale, upper=(centre + reach) / scale)
    return dict(what=what, value=share, unit="", n=n) | bounds


@contextlib.contextmanager
def _parent(folder) -> Iterator[Path]:
    """Gives the folder that runs are kept in, or a temporary one."""
    with tempfile.TemporaryDirectory() as temporary:
        parent = Path(folder or temporary).resolve()
        parent.mkdir(parents=True, exist_ok=True)
        yield parent


def _trained(parent, name, device, seconds, *words) -> Path:
    """Returns a run folder, trained if it is not there."""
    run, unfinished = parent / name, parent / f"{name}.unfinished"
    if not run.exists():
        shutil.rmtree(unfinished, ignore_errors=True)
        limits = f"seconds={seconds}", f"device={device}", f"folder={unfinished}"
        _run("train.py", *words, *NO_FINISH, *limits, "logger=none")
        unfinished.rename(run)
    return run


def _evaluated(run, device, *words, episodes=None) -> list[dict]:
    """Evaluates a run. Returns the rows of its table."""
    episodes = episodes or EPISODES[device.type]
    _run("evaluate.py", f"run={run}", f"device={device}", f"episodes={episodes}", *words)
    return newest_evaluation(run)


def _run(*words) -> None:
    """Runs a script. What it prints is shown only if it fails, which raises CalledProcessError."""
    command = [sys.executable, *words]
    process = subprocess.run(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    if process.returncode:
        print(process.stdout[-4000:], file=sys.stderr)
        process.check_returncode()
