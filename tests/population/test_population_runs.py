"""Populations, from the command line."""

import contextlib
import functools
import itertools
import random
import re
import shutil
import time
from pathlib import Path

import pytest
import yaml

from megastep.agents.algorithms.learner import GradientLearner
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.cli import entry, train
from megastep.agents.errors import UserError
from megastep.agents.launch.finishing import compare
from megastep.agents.population.population import Population
from megastep.agents.runs import checkpoint, json_lines, populations, scores
from megastep.agents.training.trainer import Trainer
from tests.cli.test_exact_resume import CASES, differences
from tests.helpers import faults, tiny
from tests.helpers.processes import HUNG, forked

pytestmark = pytest.mark.usefixtures("here")
SMALL = [
    "env=tests.cli.test_exact_resume:Steered",
    *tiny.TINY[2:],
    *("env.n_envs=32", "logging.every=2", "logger=none"),
]
VARY = (
    "population.vary={learner.lr: {min: 1e-4, max: 3e-2, log: true}, "
    "learner.entropy_coef: {choices: [0.001, 0.01, 0.03]}}"
)
POPULATION = [*SMALL, "population.size=3", "population.every=512", VARY, "folder=P"]
LONG = "samples=5120"


def run(*words):
    assert train.main([*words]) == 0


def refused(capsys, *words, code=2):
    assert train.main([*words]) == code
    return capsys.readouterr().err


def state(folder):
    return checkpoint.load_latest(f"{folder}/checkpoints").state


def files(root, n=3):
    names = [f"member-{n}/{name}" for n in range(n) for name in ("metrics.jsonl", "annealing.f64")]
    return {name: (root / name).read_bytes() for name in (*names, populations.FILE)}


def assert_equal(one, other, n=3):
    assert files(one, n) == files(other, n)
    for member in range(n):
        states = [state(populations.folder_of(root, member)) for root in (one, other)]
        assert differences(*states) == []


@pytest.mark.parametrize(
    "device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)], ids=["cpu", "cuda"]
)
def test_members_have_the_bits_of_runs_alone(here, device):
    """Until a member first copies, which none does here."""
    words = [*POPULATION, "samples=1024", "population.every=1e9", f"device={device}"]
    run(*words)
    for member in range(3):
        config = yaml.safe_load((here / f"P/member-{member}/config.yaml").read_text())
        run(
            *(*SMALL, "samples=1024", f"folder=alone-{member}", f"device={device}"),
            f"seed={config['seed']}",
            f"learner.lr={config['learner']['lr']!r}",
            f"learner.entropy_coef={config['learner']['entropy_coef']}",
        )
        states = [state(f"{name}-{member}") for name in ("P/member", "alone")]
        assert differences(*states) == []
        ours, theirs = (here / f"{name}-{member}/metrics.jsonl" for name in ("P/member", "alone"))
        assert ours.read_bytes() == theirs.read_bytes()
    settings = [
        populations.settings_of(row) for row in populations.read(here / "P" / "population.jsonl")[0]
    ]
    assert len({one["learner.lr"] for one in settings}) == 3


def test_all_members_are_launched_before_a_report_waits(here, monkeypatch):
    events = []
    for name in ("update", "report"):
        method = getattr(Trainer, name)

        def noted(*arguments, name=name, method=method):
            events.append(name)
            return method(*arguments)

        monkeypatch.setattr(Trainer, name, noted)
    run(*POPULATION, "samples=1024", "population.every=1e9")
    groups = {(name, len([*group])) for name, group in itertools.groupby(events)}
    assert groups == {("update", 6), ("report", 3)}


@pytest.mark.parametrize(
    "device, n", [("cpu", 1), pytest.param("cuda", 3, marks=pytest.mark.cuda)], ids=["cpu", "cuda"]
)
def test_seconds_count_once_all_members_are_prepared(monkeypatch, device, n):
    """Their clock is started again after each update that compiles or records."""
    start, started_at = Trainer.start_clock, []

    def started(self):
        started_at.append(self.updates)
        start(self)

    monkeypatch.setattr(Trainer, "start_clock", started)
    run(*POPULATION, "samples=2560", f"device={device}")
    first, *others = started_at  # a trainer starts it by itself after its first update
    assert first == 1 and others == [update for update in range(1, n + 1) for _ in range(3)]


class Killed(BaseException):
    """In place of a signal that leaves no time."""


def test_killed_and_interrupted_population_has_the_same_bits(here, monkeypatch, capsys):
    """Killed between the copies of a generation, before its checkpoint, and between the checkpoints
    of two members; what is saved is then of different samples.
    """
    run(*POPULATION, LONG)
    shutil.move("P", "left-alone")
    generations = populations.read(here / "left-alone" / populations.FILE)
    copied = [
        (g, row["member"])
        for g, rows in enumerate(generations)
        for row in rows
        if row["from"] != row["member"]
    ]
    assert len(copied) >= 3 and len(generations) == 10
    copy, save, calls = GradientLearner.copy_from, Population.save, []

    def killed_in_copy(self, other):
        calls.append("copy")
        if len(calls) == 2:
            raise Killed
        copy(self, other)

    def killed_in_save(self):
        calls.append("save")
        if len(calls) < 9:
            return save(self)
        for trainer in self.trainers:
            trainer.saver.wait()
        self.trainers[0].save()
        self.trainers[0].saver.wait()
        raise Killed

    for words, owner, name, fault in (
        (
            [*POPULATION, LONG, "checkpoints.seconds=1e-9"],
            GradientLearner,
            "copy_from",
            killed_in_copy,
        ),
        (["resume=P", "checkpoints.seconds=1e-9"], Population, "save", killed_in_save),
    ):
        with monkeypatch.context() as patch, pytest.raises(Killed):
            patch.setattr(owner, name, fault)
            train.main(words)
    steps = [checkpoint.list_checkpoints(here / f"P/member-{n}/checkpoints")[-1] for n in (0, 1)]
    assert checkpoint.step_of(steps[0]) > checkpoint.step_of(steps[1])
    run("resume=P")
    assert_equal(here / "P", here / "left-alone")
    assert "bit for bit" not in capsys.readouterr().out


def test_population_killed_in_its_first_checkpoint_begins_again(here, monkeypatch, capsys):
    """No member has one then, or one of them has."""
    words = [*POPULATION, "samples=1024"]
    run(*words)
    shutil.move("P", "left-alone")

    def killed(self, n_saved):
        for trainer in self.trainers[:n_saved]:
            trainer.save()
            trainer.saver.wait()
        raise Killed

    for n_saved in (0, 1):
        shutil.rmtree("P", ignore_errors=True)
        with monkeypatch.context() as patch, pytest.raises(Killed):
            patch.setattr(Population, "save", functools.partialmethod(killed, n_saved))
            train.main([*words, "checkpoints.seconds=1e-9"])
        run("resume=P")
        assert "so all begin again" in capsys.readouterr().out
        assert_equal(here / "P", here / "left-alone")
    for path in checkpoint.list_checkpoints(here / "P/member-1/checkpoints"):
        shutil.rmtree(path)  # later, this is an error
    assert "no intact checkpoint after the same" in refused(capsys, "resume=P", "more_samples=512")


def test_population_without_scores_copies_nobody_and_names_no_best(here, capsys):
    world = *tiny.TINY, "env.shortest=1000", "env.longest=1000"
    run(*world, *POPULATION[len(SMALL) - 3 :], "samples=1536")
    out = capsys.readouterr().out
    assert "No member had a score when others could copy it" in out
    assert "No member has a score, so none is the best" in out and "evaluate it" not in out
    rows = [row for rows in populations.read(here / "P" / populations.FILE) for row in rows]
    assert len(rows) == 9 and all(row["from"] == row["member"] for row in rows)
    assert entry.run_command("evaluate", ["run=P", "device=cpu"]) == 2
    assert "choose one with member=, 0 to 2" in capsys.readouterr().err
    for words, text in (
        (["member=1"], "member: is for init= and rerun=; resume=P/member-1 continues that member"),
        (["member=7"], "P has no member 7; its members are 0 to 2"),
    ):
        assert text in refused(capsys, "resume=P", *words, "more_samples=64")
    assert "P/member-1 is a single run" in refused(capsys, "resume=P/member-1", "member=1")


def test_full_disk_is_a_warning_and_loses_no_generation(here, monkeypatch, capsys):
    words = [*POPULATION, "samples=1536"]
    run(*words)
    shutil.move("P", "left-alone")
    write = Population._write

    def written(self, *arguments):
        with faults.full_disk() if self.generation == 1 else contextlib.nullcontext():
            write(self, *arguments)
            assert self._are_written() == (self.generation != 1)  # else no checkpoint follows

    monkeypatch.setattr(Population, "_write", written)
    run(*words)
    text = "population.jsonl cannot be written ([Errno 27] File too large); the run goes on"
    assert capsys.readouterr().err.count(text) == 1
    assert files(here / "P") == files(here / "left-alone")


def test_a_repeated_population_has_the_same_bits(here, monkeypatch, capsys):
    """Its budget was extended, and no generation was where the first one ended. The repetition is
    killed and resumed.
    """
    run(*POPULATION, "samples=1024")
    run("resume=P", "more_samples=1536")
    generations = populations.read(here / "P" / populations.FILE)
    assert [rows[0]["samples"] for rows in generations] == [0, 512, 1536, 2048]
    assert any(row["from"] != row["member"] for rows in generations for row in rows)
    step, calls = Population.take_over, []

    def interrupted(self):
        calls.append(1)
        if len(calls) == 3:
            raise Killed
        step(self)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(Population, "take_over", interrupted)
        train.main(["rerun=latest", "folder=again", "checkpoints.seconds=1e-9"])
    capsys.readouterr()
    run("resume=again")
    assert "of all 3 members equal those of P, byte for byte" in capsys.readouterr().out
    assert_equal(here / "P", here / "again")

    copied = next(row for rows in generations for row in rows if row["from"] != row["member"])
    words = "rerun=P", f"member={copied['member']}", "folder=one"
    err = refused(capsys, *words, code=1)
    assert f"in generation {copied['generation']} it copied another member" in err
    assert "rerun=P repeats the whole population" in err
    assert populations.first_copy(Path("P/member-9")) is None
    assert populations.first_copy(Path("one")) is None

    with open("P/member-1/metrics.jsonl", "a") as file:
        file.write("{}\n")
    with pytest.raises(UserError, match="member-1/metrics.jsonl differs from that of P from line"):
        compare(Path("again"), Path("P"))
    (here / "P" / populations.FILE).unlink()
    err = refused(capsys, "rerun=P", "folder=third")
    assert "population.jsonl does not hold the generations" in err and err.count("\n") == 1
    assert not Path("third").exists()


def test_a_member_that_diverges_is_replaced_and_named(here, capsys):
    words = [*POPULATION[:-2], "population.vary={learner.lr: {choices: [1e-3, 1e6]}}"]
    words = [
        *words,
        "population.size=4",
        "seed=3",
        "folder=D",
        "samples=10240",
        "population.every=4096",
    ]
    run(*words)
    rows = [row for rows in populations.read(here / "D" / populations.FILE) for row in rows]
    diverged = [row for row in rows if row.get("diverged")]
    assert diverged and all(row["from"] != row["member"] for row in diverged)
    assert "diverged" in capsys.readouterr().out


def test_members_are_ranked_by_another_statistic_of_their_last_report(here, capsys):
    world = *tiny.TINY, *tiny.SHORT_EPISODES  # of different lengths
    run(*world, *POPULATION[len(SMALL) - 3 :], LONG, "population.score=length")
    out = capsys.readouterr().out
    assert " length " in out
    reports = [json_lines.read(here / f"P/member-{n}/metrics.jsonl") for n in range(3)]
    generations = populations.read(here / "P" / populations.FILE)
    assert any("score" in row for rows in generations for row in rows)
    for rows in generations[1:]:
        for row, of_member in zip(rows, reports, strict=True):
            report = next(one for one in of_member if one["samples"] == row["samples"])
            if "score" in row:
                assert row["score"] == report["episode/length"]
    lengths = [scores.mean(rows, "length") for rows in reports]
    assert lengths != [rows[-1]["episode/length"] for rows in reports]
    assert re.findall(r"(?m)^│ \d +│ ([\d.]+) ", out) == [f"{length:.4g}" for length in lengths]
    best = lengths.index(max(lengths))
    assert populations.best(here / "P") == best and f"P/member-{best}\n" in out


BAD = {
    "key": (["population.vary={agent.width: {min: 8, max: 16}}"], "agent.width cannot vary"),
    "upside down": (["population.vary={learner.lr: {min: 3e-3, max: 3e-4}}"], "swap them"),
    "bounds": (["population.vary={learner.gamma: {min: 0.9, max: 1.1}}"], "out of range"),
    "log": (
        ["population.vary={learner.clip: {min: 0, max: 1, log: true}}"],
        "out of range|above 0",
    ),
    "schedule": (["learner.lr={from:1e-3,to:1e-4}"], "is a schedule"),
    "evaluated": (["population.score=evaluated"], "evaluation.every"),
    "league": (["population.score=won/league"], "is not a mean over episodes here"),
    "ranks": (["ranks=4"], "more than population.size=3"),
    "member": (["population.member=1"], "is set by a population"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_sentence(here, capsys, case):
    words, text = BAD[case]
    err = refused(capsys, *POPULATION, "samples=64", *words)
    assert any(part in err for part in text.split("|")), err
    assert "Traceback" not in err and not (here / "P").exists()


class WithoutCopies(PPO):
    """A learner that cannot copy itself."""

    copy_from = None


def test_a_learner_that_cannot_copy_is_refused(here, capsys):
    learner = f"learner={__name__}:WithoutCopies"
    err = refused(capsys, *POPULATION, "samples=64", learner)
    assert "WithoutCopies has no copy_from(other)" in err and not (here / "P").exists()


def test_more_members_than_memory_holds_are_refused_before_anything_is_built(here, capsys):
    words = [
        *("env=explorer", *tiny.TINY[1:]),
        "env.n_envs=500000",
        "population.size=1000",
        "samples=64",
        "folder=P",
    ]
    err = refused(capsys, *words)
    assert "members (population.size) need" in err and "fit" in err
    assert not (here / "P").exists()


def test_agents_of_a_population_are_evaluated_and_start_runs(here, capsys):
    run(*POPULATION, "samples=2560")
    words = ["split=training", "episodes=4", "baseline=none", "device=cpu", "max_steps=4"]
    assert entry.run_command("evaluate", ["run=P", "member=2", *words]) == 0
    assert list((here / "P/member-2/evaluations").iterdir())
    assert entry.run_command("evaluate", ["run=P", *words]) == 0
    best = populations.best(here / "P")
    assert list((here / f"P/member-{best}/evaluations").iterdir())
    assert entry.run_command("report", ["run=P"]) == 0
    page = (here / "P/report.html").read_text()
    assert "<h2>Population</h2>" in page and "score of the population" in page
    for member, rows in enumerate(zip(*populations.read(here / "P" / populations.FILE))):
        cells = [f"{row['generation']} from {row['from']}" for row in rows if row["from"] != member]
        assert (", ".join(cells) or "never") in page
    assert entry.run_command("evaluate", ["run=P", "member=7", *words]) == 2
    assert "has no member 7" in capsys.readouterr().err
    assert entry.run_command("export", ["run=P", "member=1", "format=safetensors"]) == 0
    assert (here / "P/member-1/agent.safetensors").exists()
    run("init=P", "member=2", "samples=128", "folder=next", "device=cpu")
    weights, own = ({**state(f)["policy"]} for f in ("next", "P/member-2"))
    assert weights.keys() == own.keys()
    assert "member-2" in (here / "next/config.yaml").read_text()


@pytest.mark.slow
def test_members_of_a_league_meet_each_other_and_resume_with_the_same_bits(here, capsys):
    """Their opponents are, in turn, the other members' policies of the time."""
    small = [word for word in tiny.TINY if not word.startswith(("env", "geometry"))]
    words = [*small, "env=pong", "env.self_play=true", "env.points=1", "env.n_envs=8"]
    words += ["opponents.league=0.5", "opponents.past=0.25", "opponents.snapshots=2"]
    words += ["opponents.every=3", "population.size=3", "population.every=240", "logger=none"]
    words += [VARY, "samples=480", "population.score=won/league"]
    run(*words, "folder=L", "checkpoints.seconds=1e-9", "checkpoints.keep=99")
    shutil.copytree("L", "left-alone")
    won = [json_lines.read(here / f"L/member-{n}/metrics.jsonl")[-1] for n in range(3)]
    assert any("episode/return/league" in row for row in won)
    paths = checkpoint.list_checkpoints(here / "L/member-0/checkpoints")
    early, after = paths[1], paths[4]
    states = [checkpoint.load_latest(path).state for path in (early, after)]
    rivals = [one["opponents"]["snapshots"]["2"] for one in states]
    assert states[0]["updates"] < 3 < states[1]["updates"] < 6
    at_refresh = checkpoint.load_latest(here / "L/member-1/checkpoints" / paths[2].name).state
    assert differences(rivals[1], {k: at_refresh["policy"][k] for k in rivals[1]}) == []
    assert differences(rivals[0], rivals[1]) != []
    for n in range(3):
        for path in checkpoint.list_checkpoints(here / f"L/member-{n}/checkpoints")[5:]:
            shutil.rmtree(path)
    run("resume=L")
    assert_equal(here / "L", here / "left-alone")
    err = refused(capsys, *words, "population.size=1", "population.vary={}", "folder=M")
    assert "opponents.league" in err and "population.size=2" in err


@pytest.mark.nightly
def test_population_that_is_killed_at_random_moments_has_the_same_bits(here, n_kills=30):
    """By SIGKILL: every third time whenever it starts, otherwise after it has saved, in whatever it
    does then.
    """
    words = [*POPULATION, f"samples={1024 * n_kills}", "device=cpu"]
    run(*words)
    shutil.move("P", "left-alone")
    generator, n_killed, seen = random.Random(1), 0, set()
    while n_killed < n_kills:
        paths = [here / f"P/member-{n}/checkpoints" for n in range(3)]
        is_new = not all(map(checkpoint.list_checkpoints, paths))
        if is_new:
            shutil.rmtree("P", ignore_errors=True)
        before = set() if is_new else {*checkpoint.list_checkpoints(paths[2])}
        start = [*words, "checkpoints.seconds=1e-9"] if is_new else ["resume=P"]
        process = forked("train", *start, cwd=here)
        while n_killed % 3 and not {*checkpoint.list_checkpoints(paths[2])} - before:
            if process.poll() is not None:
                break
            time.sleep(0.001)
        time.sleep(generator.uniform(0, 0.3 if n_killed % 3 else 3))
        if process.poll() is not None:
            break
        process.kill()
        process.communicate(timeout=HUNG)
        n_killed += 1
        seen |= {*map(newest, paths)}
    print(f"{n_killed} kills, after {len(seen)} numbers of samples")
    assert n_killed >= n_kills / 2 and len(seen) > n_kills / 2
    if process.returncode != 0:
        run("resume=P")
    assert_equal(here / "P", here / "left-alone")


def newest(folder):
    """Returns the name of the newest checkpoint in a folder, None without one."""
    paths = checkpoint.list_checkpoints(folder)
    return paths[-1].name if paths else None


@pytest.mark.nightly
@pytest.mark.parametrize("case", ("r2d2", "vtrace", "wrappers"))
def test_copies_of_every_learner_resume_with_the_same_bits(here, monkeypatch, case):
    """What a copy leaves out would come back from the checkpoint, or not."""

    def drawn(self, trainer):
        member = self.trainers.index(trainer)
        return random.Random(f"{trainer.samples} {member}").random()

    monkeypatch.setattr(Population, "score_of", drawn)
    words = [*CASES[case], "logging.every=2", "logger=none", "samples=384", "folder=P"]
    words += ["population.size=3", "population.every=96"]
    words += ["population.vary={learner.lr: {min: 1e-4, max: 3e-2, log: true}}"]
    run(*words, "checkpoints.seconds=1e-9", "checkpoints.keep=99")
    rows = [row for rows in populations.read(here / "P" / populations.FILE) for row in rows]
    assert sum(row["from"] != row["member"] for row in rows) >= 3
    shutil.copytree("P", "left-alone")
    for n in range(3):
        for path in checkpoint.list_checkpoints(here / f"P/member-{n}/checkpoints")[6:]:
            shutil.rmtree(path)
    run("resume=P")
    assert_equal(here / "P", here / "left-alone")
