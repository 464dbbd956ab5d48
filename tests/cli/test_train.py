"""Training in this process, with settings composed as by the command line, in four boxes."""

import contextlib
import itertools
import json
import os
import re
import shlex
import signal
import time

import pytest
import torch
import yaml

from megastep import engine, envs
from megastep.agents.algorithms import ppo
from megastep.agents.algorithms.nonfinite import nonfinite_leaf
from megastep.agents.cli import evaluate, train
from megastep.agents.errors import ConfigErrors, UserError, shortened
from megastep.agents.factory import make as factory
from megastep.agents.factory.check import check
from megastep.agents.factory.settings import Train
from megastep.agents.launch import run as launch_run
from megastep.agents.runs import checkpoint, json_lines
from megastep.agents.training import loggers
from megastep.agents.training.trainer import Trainer
from megastep.settings import MAX_ENVS
from tests.helpers import faults, tiny
from tests.helpers.tiny import settings
from tests.helpers.weights import of_run as weights
from tests.helpers.weights import same

TINY = [*tiny.TINY, *tiny.SHORT_EPISODES, "logging.every=1"]
UPDATE = tiny.UPDATE


def configured(*overrides, tiny=TINY):
    return settings(*tiny, *overrides)


def test_files_of_a_run(here):
    folder = train.run(configured(f"samples={3 * UPDATE}"))
    assert folder.parent.name == "runs" and "minimal-box-1" in folder.name
    names = "annealing.f64 config.yaml checkpoints tensorboard metrics.jsonl perf.jsonl"
    names += " provenance.jsonl"
    assert {path.name for path in folder.iterdir()} == {*names.split()}
    written = check(Train, yaml.safe_load((folder / "config.yaml").read_text()))
    assert written == configured(f"samples={3 * UPDATE}", "learner.anneal=samples")
    rows = json_lines.read(folder / "metrics.jsonl")
    assert [row["samples"] for row in rows] == [UPDATE, 2 * UPDATE, 3 * UPDATE]
    assert [row["updates"] for row in rows] == [1, 2, 3]
    # episodes of 5 to 9 steps, and one step for the reset: two to four episodes end in 24 steps of
    # each of 4 lanes, the first of which started in its middle and is not counted
    assert 4 <= sum(row["episode/count"] for row in rows) <= 12
    assert all(5 <= row["episode/length"] <= 9 for row in rows if row["episode/count"])
    assert not any("perf" in name for row in rows for name in row)
    perf = json_lines.read(folder / "perf.jsonl")[-1]
    assert {"perf/rate", "perf/collect", "perf/update", "perf/rest"} <= set(perf)
    (start,) = json_lines.read(folder / "provenance.jsonl")
    assert start["samples"] == 0 and {"command", "device", "megastep", "torch"} <= set(start)
    loaded = checkpoint.load_latest(folder / "checkpoints")
    assert loaded.step == loaded.state["samples"] == 3 * UPDATE
    assert loaded.config["spaces"]["obs"].startswith("MultiImage")


def test_seeds(here):
    folders = [train.run(configured("samples=100", f"seed={seed}")) for seed in (1, 1, 2)]
    one, again, other = [(folder / "metrics.jsonl").read_bytes() for folder in folders]
    assert one == again != other
    assert same(weights(folders[0]), weights(folders[1])) and not same(
        weights(folders[0]), weights(folders[2])
    )


def test_resume_keeps_the_configuration_and_its_means_reach_back(here):
    lengths = "env.shortest=7", "env.longest=7", "desync=false"
    folder = train.run(configured(f"samples={2 * UPDATE}", "learner.lr=0.123", *lengths))
    cfg = configured(f"resume={folder}", f"samples={4 * UPDATE}", tiny=[])
    assert cfg.learner.lr == 0.123 and cfg.env.n_envs == 4
    assert train.run(cfg) == folder
    rows = json_lines.read(folder / "metrics.jsonl")
    assert [row["samples"] for row in rows] == [n * UPDATE for n in (1, 2, 3, 4)]
    assert [row["episode/count"] for row in rows] == [0, 8, 4, 4]
    assert [row.get("episode/window") for row in rows] == [None, 8, 12, 16]
    assert [row["episode/length"] for row in rows[1:]] == [7, 7, 7]
    assert yaml.safe_load((folder / "config.yaml").read_text())["samples"] == 4 * UPDATE
    starts = json_lines.read(folder / "provenance.jsonl")
    assert [start["samples"] for start in starts] == [0, 2 * UPDATE]


def clock_jumps(monkeypatch, seconds):
    """Has the clock go on by a millisecond with each reading, and jump ahead by `seconds` at its
    12th, early in a run.
    """
    readings = itertools.count()
    monkeypatch.setattr(
        time, "monotonic", lambda: 1e-3 * (n := next(readings)) + seconds * (n >= 12)
    )


def test_seconds_and_log_every(here, monkeypatch):
    clock_jumps(monkeypatch, 0)
    folder = train.run(configured("seconds=0.1", "logging.every=2"))
    rows = json_lines.read(folder / "metrics.jsonl")
    *updates, last = [row["updates"] for row in rows]
    assert updates == list(range(2, len(updates) * 2 + 1, 2)) and 0 < last - len(updates) * 2 <= 2
    assert 0.1 <= checkpoint.load_latest(folder / "checkpoints").state["seconds"] < 0.2
    assert rows[0]["lr"] > rows[-1]["lr"] and {row["anneal"] for row in rows} == {"seconds"}
    written = yaml.safe_load((folder / "config.yaml").read_text())
    assert written["learner"]["anneal"] == "seconds"


def test_metrics_do_not_depend_on_the_clock(here, monkeypatch):
    """Nor do learning rates, though in the second run most of the seconds are gone at once."""
    lr, n, files = 0.01, 4, []
    for seconds in (0, 900):
        clock_jumps(monkeypatch, seconds)
        folder = train.run(configured(f"samples={n * UPDATE}", "seconds=1000", f"learner.lr={lr}"))
        files.append((folder / "metrics.jsonl").read_bytes())
    assert files[0] == files[1]
    rows = json_lines.read(folder / "metrics.jsonl")
    assert [row["lr"] for row in rows] == pytest.approx([lr * (1 - i / n) for i in range(n)])
    assert {row["anneal"] for row in rows} == {"samples"}
    written = yaml.safe_load((folder / "config.yaml").read_text())
    assert written["learner"]["anneal"] == "samples"


def test_resume_refuses_changed_settings(here):
    folder = train.run(configured("samples=1"))
    with pytest.raises(ConfigErrors) as error:
        configured(f"resume={folder}", "learner.lr=1", "env=explorer", "finish.episodes=3", tiny=[])
    assert {key for key, _ in error.value.errors} == {"learner.lr", "env"}
    assert "init=RUN" in str(error.value)


def test_resume_skips_a_damaged_checkpoint(here):
    folder = train.run(configured(f"samples={2 * UPDATE}", "checkpoints.seconds=1e-9"))
    os.truncate(folder / "checkpoints" / f"step_{2 * UPDATE}" / "state.pt", 50)
    with pytest.warns(
        UserWarning, match=f"step_{2 * UPDATE} is damaged.*using step_{UPDATE} instead"
    ):
        train.run(configured("resume=latest", tiny=[]))
    assert [row["samples"] for row in json_lines.read(folder / "metrics.jsonl")] == [
        UPDATE,
        2 * UPDATE,
    ]
    assert checkpoint.load_latest(folder / "checkpoints").step == 2 * UPDATE


@pytest.fixture
def saved_often(here):
    """A run of four updates with a checkpoint after each."""
    often = "checkpoints.seconds=1e-9", "checkpoints.keep=9"
    return train.run(configured(f"samples={4 * UPDATE}", *often))


def test_resume_from_an_earlier_checkpoint(saved_often):
    folder, first = saved_often, saved_often / "checkpoints" / f"step_{UPDATE}"
    before = (folder / "metrics.jsonl").read_bytes()
    train.run(configured(f"resume={first}", f"samples={2 * UPDATE}", tiny=[]))
    assert checkpoint.load_latest(folder / "checkpoints").step == 2 * UPDATE
    train.run(configured("resume=latest", f"samples={5 * UPDATE}", tiny=[]))
    rows = json_lines.read(folder / "metrics.jsonl")
    assert [row["samples"] for row in rows] == [n * UPDATE for n in (1, 2, 3, 4, 5)]
    assert (folder / "metrics.jsonl").read_bytes().startswith(before.partition(b"\n")[0])
    assert checkpoint.load_latest(folder / "checkpoints").step == 5 * UPDATE


def test_init(here):
    first = train.run(configured("samples=1"))
    second = train.run(configured("samples=1", "learner.lr=1e-12", f"init={first}", "seed=2"))
    name = next(name for name in weights(first) if "weight" in name)
    torch.testing.assert_close(weights(first)[name], weights(second)[name], atol=1e-6, rtol=0)
    assert checkpoint.load_latest(second / "checkpoints").step == UPDATE  # it counts from zero


def test_init_refuses_other_shapes(here):
    first = train.run(configured("samples=1"))
    with pytest.raises(UserError, match=r"obs was MultiImage\(.*W=8\) and is MultiImage\(.*W=16\)"):
        train.run(configured("samples=1", f"init={first}", "env.res=16"))
    with pytest.raises(UserError, match="agent.width=8.*size mismatch.*8, 24.*16, 24"):
        train.run(configured("samples=1", f"init={first}", "agent.width=16"))
    names = [path.name for path in (here / "runs").iterdir()]
    assert sorted(names) == [first.name, "started.txt"]  # the refused runs left nothing behind


def test_resume_after_a_signal(here, monkeypatch, capsys):
    real = loggers.Loggers.write

    def write(self, step, *values):
        real(self, step, *values)
        if step == 2 * UPDATE:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(loggers.Loggers, "write", write)
    assert train.main([*TINY, "samples=1e9", 'folder="r n ü"']) == 143
    (command,) = re.findall("To continue: python train.py (.*)", capsys.readouterr().err)
    assert train.main([*shlex.split(command), f"samples={3 * UPDATE}"]) == 0
    rows = json_lines.read(here / "r n ü" / "metrics.jsonl")
    assert [row["samples"] for row in rows] == [UPDATE, 2 * UPDATE, 3 * UPDATE]
    assert checkpoint.load_latest(here / "r n ü" / "checkpoints").step == 3 * UPDATE


@pytest.mark.parametrize(
    ("length", "why"),
    [
        (50, "an episode has more than 8 steps"),
        (5, "not all episodes that began before the last report have ended"),
    ],
)
def test_a_run_too_short_for_a_mean_says_why(length, why, here, capsys):
    lengths = f"env.shortest={length}", f"env.longest={length}", "desync=false"
    assert train.main([*TINY, "samples=32", *lengths, "folder=run"]) == 0
    text = f"no mean return yet: {why}, and each of 4 lanes took 8; give samples=64, or more "
    assert text in capsys.readouterr().out


def test_a_run_ends_with_its_result_and_the_next_command(here, capsys):
    assert train.main([*TINY, "samples=100", "folder=run 1"]) == 0
    *_, result, following = capsys.readouterr().out.splitlines()
    last = json_lines.read(here / "run 1" / "metrics.jsonl")[-1]
    text = r"Trained (\d+) samples in \d+ s; mean return (\S+) of the last (\d+) episodes. (.*)"
    samples, mean, n_episodes, where = re.fullmatch(text, result).groups()
    assert int(samples) == last["samples"] and int(n_episodes) == last["episode/window"]
    assert float(mean) == pytest.approx(last["episode/return"], rel=1e-3)
    assert where == "The run is in run 1"
    words = shlex.split(following.removeprefix("To evaluate it: python evaluate.py "))
    assert evaluate.main([*words, "episodes=2", "device=cpu"]) == 0


def test_resume_refuses_a_spent_budget(here, capsys):
    folder = train.run(configured(f"samples={2 * UPDATE}", "seconds=600"))
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    for more in ([], ["samples=40"], ["samples=9e3", "seconds=1e-9"]):
        assert train.main([f"resume={folder}", *more]) == 2
    assert before == {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert train.main([f"resume={folder}", f"more_samples={UPDATE}"]) == 0
    assert checkpoint.load_latest(folder / "checkpoints").step == 3 * UPDATE
    written = yaml.safe_load((folder / "config.yaml").read_text())
    assert (written["samples"], written["more_samples"]) == (3 * UPDATE, None)


@pytest.mark.parametrize(
    "damage, sentence",
    [
        (lambda env, actions: env.core.agents.positions[2].fill_(torch.nan), "non-finite"),
        (lambda env, actions: env.core.scenery.layout[2].fill_(10**6), "layout"),
        (lambda env, actions: actions[2].fill_(99), "action"),
    ],
)
def test_error_on_the_device_names_the_environment_and_keeps_what_was_learnt(
    here, monkeypatch, capsys, damage, sentence
):
    real, steps = envs.Minimal.step, itertools.count(1)

    def step(self, decision):
        if next(steps) == 13:
            damage(self, decision["actions"])
        return real(self, decision)

    monkeypatch.setattr(envs.Minimal, "step", step)
    assert train.main([*TINY, "samples=1e9", "folder=run"]) == 2
    (text,) = capsys.readouterr().err.splitlines()
    assert re.search(rf"[Ee]nvironment 2 .*{sentence}", text) and "run" in text
    assert len(json_lines.read(here / "run" / "metrics.jsonl")) == 1
    loaded = checkpoint.load_latest(here / "run" / "checkpoints")
    assert loaded.step == UPDATE and nonfinite_leaf(loaded.state) is None
    assert f"All {UPDATE} samples are saved" in text
    # the damaged environments are not saved: a resumed run begins new episodes
    assert train.main(["resume=run", f"samples={2 * UPDATE}"]) == 0
    assert "new episodes start" in capsys.readouterr().out


def inject(monkeypatch, name, step, value, lane=2):
    """Replaces a number of one lane in the given steps of the environment."""
    real, steps = envs.Minimal.step, itertools.count(1)
    faulty = step if isinstance(step, range) else [step]

    def with_fault(self, decision):
        world = real(self, decision)
        if next(steps) in faulty:
            world[name][lane] = value
        return world

    monkeypatch.setattr(envs.Minimal, "step", with_fault)


@pytest.mark.parametrize("name, value", [("reward", float("nan")), ("obs", 1e30)])
def test_non_finite_world_exits_with_1(here, monkeypatch, capsys, name, value):
    inject(monkeypatch, name, step=13, value=value)
    assert train.main([*TINY, f"samples={8 * UPDATE}", "folder=run"]) == 1
    warning, sentence = capsys.readouterr().err.splitlines()
    named = f"{name} of lane 2 was {'inf' if name == 'obs' and value > 0 else f'{value:g}'} at step"
    assert named in warning and named in sentence
    rows = json_lines.read(here / "run" / "metrics.jsonl")
    assert [row["loss/skipped_steps"] for row in rows] == [0, 2, 0, 0, 0, 0, 0, 0]
    loaded = checkpoint.load_latest(here / "run" / "checkpoints")
    assert loaded.step == 8 * UPDATE and nonfinite_leaf(loaded.state) is None


def test_repeated_non_finite_updates_stop(here, monkeypatch, capsys):
    inject(monkeypatch, "reward", step=range(17, 10**6), value=float("nan"))
    assert train.main([*TINY, "samples=1e9", "folder=run", "logging.every=8"]) == 1
    _, sentence = capsys.readouterr().err.splitlines()
    assert "The last 22 updates were skipped" in sentence and "reward of lane 2 was nan" in sentence
    loaded = checkpoint.load_latest(here / "run" / "checkpoints")
    assert loaded.step == 24 * UPDATE and nonfinite_leaf(loaded.state) is None
    monkeypatch.undo()
    monkeypatch.chdir(here)
    assert train.main(["resume=run", f"samples={26 * UPDATE}"]) == 0


def test_divergence_stops_with_advice(here, capsys):
    words = ["env=explorer", *tiny.TINY[1:], "logging.every=1", "learner.lr=1e3", "samples=1e5"]
    assert train.main([*words, "checkpoints.seconds=1e-9", "folder=run"]) == 1
    sentence = capsys.readouterr().err.splitlines()[-1]
    assert "learning rate smaller than 1000" in sentence
    assert len(json_lines.read(here / "run" / "metrics.jsonl")) < 100
    assert nonfinite_leaf(checkpoint.load_latest(here / "run" / "checkpoints").state) is None


def error_of_allocator():
    with pytest.raises(RuntimeError) as error:
        torch.empty(2**55)
    return error.value


CUDA_ERROR = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.\nMore")


@pytest.mark.parametrize("error", [CUDA_ERROR, error_of_allocator(), MemoryError()])
def test_out_of_memory_while_training(here, monkeypatch, capsys, error):
    real = ppo.PPO.update

    def update(self, rollout):
        if self.check.record[0] == 2:
            raise error
        return real(self, rollout)

    with monkeypatch.context() as patch:
        patch.setattr(ppo.PPO, "update", update)
        assert train.main([*TINY, "samples=1e9", "folder=run"]) == 2
    (sentence,) = capsys.readouterr().err.splitlines()
    assert " memory" in sentence and f"All {2 * UPDATE} samples are saved" in sentence
    assert "python train.py resume=run" in sentence
    assert checkpoint.load_latest(here / "run" / "checkpoints").step == 2 * UPDATE
    assert train.main(["resume=run", f"samples={3 * UPDATE}"]) == 0
    assert checkpoint.load_latest(here / "run" / "checkpoints").step == 3 * UPDATE


def test_disk_that_fills_up(here, monkeypatch, capsys):
    real, full = Trainer.report, contextlib.ExitStack()

    def report(self):
        real(self)
        if self.updates == 2:
            self.saver.wait()  # the first checkpoint is written
            full.enter_context(faults.full_disk(8000))

    with full, monkeypatch.context() as patch:
        patch.setattr(Trainer, "report", report)
        code = train.main(
            [*TINY, f"samples={5 * UPDATE}", "checkpoints.seconds=1e-9", "folder=run"]
        )
    warning, error = capsys.readouterr().err.splitlines()
    assert code == 2
    assert "at 64 samples could not be saved (the disk is full or cannot be written)" in warning
    assert "at 160 samples could not be saved" in error
    assert re.search(r"it needs about [\d.]+ MB, and [\d.]+ MB are free in run", error)
    assert len(json_lines.read(here / "run" / "metrics.jsonl")) == 5
    assert train.main(["resume=run"]) == 0
    assert checkpoint.load_latest(here / "run" / "checkpoints").step == 5 * UPDATE


def test_settings_that_no_environment_can_have(here, capsys):
    explorer = [word for word in TINY if "est=" not in word] + ["env=explorer", "env.subsample=3"]
    elsewhere = [word for word in TINY if "est=" not in word] + ["env=pointgoal"]
    (here / "bad.npz").write_bytes(b"no archive")
    for words, message in (
        ([*TINY, "geometry=files", "geometry.path=bad.npz"], "bad.npz"),
        ([*elsewhere, "env.nearest=40", "env.furthest=50"], "geometry 0 has no goal from 40 to 50"),
        ([*elsewhere, "env.nearest=5", "env.furthest=2"], "nearest < furthest metres, but 5 and 2"),
        ([*TINY, "env.shortest=10"], "shortest=10 and longest=9"),
        (explorer, "subsample=3 does not divide the 8 rays"),
    ):
        assert train.main(words) == 2
        (sentence,) = capsys.readouterr().err.splitlines()
        assert message in sentence and not any(here.glob("runs/*"))


def test_too_many_environments(here, capsys):
    assert train.main([*TINY, f"env.n_envs={MAX_ENVS}", "learner.n_steps=4096"]) == 2
    message = re.search(
        "67,108,864 environments need .* free on cpu may be used: at most ([0-9,]+) fit",
        capsys.readouterr().err,
    )
    assert 10 < int(message[1].replace(",", "")) < MAX_ENVS
    assert not any((here / "runs").iterdir())


@pytest.mark.parametrize("folder", ["file/below", "/proc/run", "full", "link", 300 * "x"])
def test_unusable_run_folder(here, monkeypatch, capsys, folder):
    (here / "file").write_text("")
    (here / "link").symlink_to("nowhere")
    (here / "full").mkdir()
    (here / "full" / "mine.txt").write_text("")
    monkeypatch.setattr(launch_run, "make_trainer", None)
    assert train.main([*TINY, f"folder={folder}"]) == 2
    error = capsys.readouterr().err.strip()
    assert shortened(folder) in error and "folder=" in error and "\n" not in error
    assert "resume=" not in error, "there is no checkpoint"
    left = {path.relative_to(here).as_posix() for path in here.rglob("*")}
    assert left == {"file", "full", "full/mine.txt", "link"}


def test_finish(here, capsys):
    words = ["finish.evaluate=true", "finish.episodes=4", "finish.record=true", "finish.steps=2"]
    folder = train.run(configured("samples=1", *words))
    (written,) = (folder / "evaluations").glob("*.json")
    result = json.loads(written.read_text())
    assert [row["agent"] for row in result["rows"]] == ["trained", "random"]
    assert (folder / "video.mp4").stat().st_size > 1000
    assert "random" in capsys.readouterr().out


def test_cpu_threads():
    before = torch.get_num_threads()
    try:
        for width, expected in ((64, 1), (256, 2), (4096, 3)):
            torch.set_num_threads(3)
            engine.set_threads(None)
            factory.share_threads(width)
            assert (torch.get_num_threads(), engine.threads()) == (expected, 3)
    finally:
        torch.set_num_threads(before)
        engine.set_threads(None)
