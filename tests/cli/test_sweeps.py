"""Sweeps through Hydra's launchers and sweepers: what their jobs leave and return, what a failing
job and a signal do. Jobs run an environment that pays a known return in milliseconds.
"""

import csv
import json
import os
import pathlib
import signal
import sys
import tempfile
from types import SimpleNamespace

import cloudpickle
import pytest
import torch
import yaml

from megastep.agents.cli import evaluate, sweeps, train
from megastep.agents.cli.command import load
from megastep.agents.cli.compose import Composer
from megastep.agents.factory.components import kind_of
from megastep.agents.launch import gpu_slots
from megastep.agents.runs import folders, scores
from tests.helpers import tiny
from tests.helpers.processes import HUNG, ROOT, finished, start, wait_until

PAYER = '''
import os
import time

import torch

from megastep.envs import Minimal


class Payer(Minimal):
    """Episodes of four steps with reward `pay` each. Fails in some moods, and takes its time in
    another, so that jobs that last for seconds leave the processor to others.
    """

    def __init__(self, *args, pay: float = 1.0, mood: str = "fine", **settings):
        if mood == "cross":
            raise RuntimeError("by chance")
        if mood == "dead":
            os._exit(3)
        if mood == "lost" and os.environ.get("RANK") == "1":
            os.kill(os.getpid(), 9)
        super().__init__(*args, shortest=4, longest=4, **settings)
        self.pay, self.pause = pay, 0.05 if mood == "slow" else 0.0  # seconds

    def step(self, decision):
        time.sleep(self.pause)
        world = super().step(decision)
        world["reward"] = torch.full_like(world.reward, self.pay).masked_fill(world.reset, 0.0)
        return world
'''
UPDATE = tiny.UPDATE
SMALL = ["env=payer:Payer", *tiny.TINY[1:], "logging.every=1"]
SHORT = [*SMALL, f"samples={2 * UPDATE}"]


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Changes to an empty folder with the environment."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    (tmp_path / "payer.py").write_text(PAYER)
    yield tmp_path
    sys.modules.pop("payer", None)
    kind_of.cache_clear()


def rows(folder):
    """Returns the rows of sweep.csv."""
    with open(pathlib.Path(folder) / "sweep.csv") as file:
        return list(csv.DictReader(file))


# ---- Hydra's own launcher and sweeper ----


def test_sweep_folders_and_table(here, capsys):
    words = [*SHORT, "-m", "seed=1,2", "env.pay=0.5,3", "finish.evaluate=true", "finish.episodes=4"]
    assert train.main([*words, "hydra.sweep.dir=mine"]) == 0
    table = rows("mine")
    names = ["0_env.pay=0.5_seed=1", "1_env.pay=3_seed=1", "2_env.pay=0.5_seed=2"]
    assert [pathlib.Path(row["folder"]).name for row in table[:3]] == names
    assert all((here / "mine" / name / "checkpoints").is_dir() for name in names)
    states = [(row["job"], row["seed"], row["env.pay"], row["state"]) for row in table]
    assert states[1:3] == [("1", "1", "3", "done"), ("2", "2", "0.5", "done")]
    for row in table:  # four steps of a known reward
        numbers = [float(row[key]) for key in ("score", "evaluated", "lower", "upper")]
        assert numbers == 4 * [4 * float(row["env.pay"])]
    lines = (here / "mine" / "sweep.md").read_text().splitlines()
    assert lines[0].split()[1:10:2] == ["job", "seed", "env.pay", "state", "score"]
    assert lines[3].split()[1:16:2] == ["1", "1", "3", "done", "12.0", "12.0", "12.0", "12.0"]
    config = yaml.safe_load((here / "mine" / names[0] / "config.yaml").read_text())
    assert config["folder"] == f"mine/{names[0]}"
    assert "sweep.md" in capsys.readouterr().out
    assert folders.find("latest") == pathlib.Path("mine/3_env.pay=3_seed=2")


def test_a_population_has_the_score_of_its_best_member(here):
    words = [*SMALL, f"samples={4 * UPDATE}", "population.size=2", f"population.every={2 * UPDATE}"]
    words += ["population.vary={learner.lr: {choices: [1e-3]}}", "logger=none"]
    assert train.main([*words, "-m", "env.pay=0.5,3", "hydra.sweep.dir=mine"]) == 0
    assert [row["score"] for row in rows("mine")] == ["2.0", "12.0"]


def test_failed_jobs(here, capsys):
    words = [*SHORT, "-m", "env.mood=cross,fine,cross", "hydra.sweep.dir=mine"]
    assert train.main(words) == 1
    failed = "FAILED: payer:Payer failed: RuntimeError: by chance. Its traceback is in mine/{}_env"
    states = [row["state"] for row in rows("mine")]
    assert states[1] == "done"
    assert all(states[k].startswith(failed.format(k)) for k in (0, 2)), states
    assert "Job 0 FAILED: payer:Payer failed: RuntimeError" in capsys.readouterr().err
    assert "by chance" in (here / "mine/0_env.mood=cross/error.txt").read_text()
    assert not (here / "mine/0_env.mood=cross/checkpoints").exists()


def test_invalid_sweep_leaves_nothing(here, capsys):
    for words, message in (
        (["seed=1,2", "learner.lr=1e-3,-1"], "learner.lr: -1 is out of range"),
        (["seed=1,2", "folder=x"], "hydra.sweep.dir="),
        (["seed=1,2", "metric=eval/success"], "metric: needs evaluations: finish.evaluate=true"),
        (["seed=1,2", "metric=loss/value"], "metric: 'loss/value' is neither episode/NAME"),
        (["hydra.launcher.n_job=3"], "hydra.launcher.n_job: no such key"),
        (["hydra.sweep.dir=payer.py/x"], "payer.py/x"),
        (["hydra.sweeper.max_batch_size=0"], "The sweep cannot start: "),
    ):
        assert train.main([*SHORT, "-m", *words]) == 2
        assert message in capsys.readouterr().err
        left = {path.name for path in here.rglob("*")} - {"payer.py", "__pycache__"}
        assert not {name for name in left if not name.startswith("payer.")}, words


@pytest.mark.parametrize("sweeper", ["basic", "optuna"])
def test_sweep_without_a_score_ends_with_the_reason(here, capsys, sweeper):
    words = ["env=minimal", *SHORT[1:], "env.shortest=1000", "env.longest=1000"]
    words += ["hydra.sweeper.n_trials=2"] * (sweeper == "optuna")
    if sweeper == "optuna":
        pytest.importorskip("optuna")
    code = train.main([*words, "-m", f"hydra/sweeper={sweeper}", "env.res=8,16"])
    err = capsys.readouterr().err
    assert code == (sweeper == "optuna") and "The launcher failed" not in err
    assert "No job has a score, so none is the best, as no episode finished" in err


def test_misspelt_metric_is_named_once_a_job_has_ended(here, capsys):
    for metric, name in (("episode/retrun", "episode/return"), ("eval/lenght", "eval/length")):
        words = [f"metric={metric}", "finish.evaluate=true", "finish.episodes=4"]
        assert train.main([*SHORT, "-m", "seed=1", *words]) == 0
        err = capsys.readouterr().err
        assert f"job 0: it has no {metric}, and so no score; did you mean {name}?" in err
        assert f"none has {metric}; did you mean {name}?" in err


def test_table_stands_while_jobs_run(here, monkeypatch):
    """Even if a job of the basic launcher ends this process, with `os._exit` or worse."""
    states = []

    def run(cfg):
        states.append([row["state"] for row in rows("mine")])

    monkeypatch.setattr(train.COMMAND, "run", run)
    assert train.main([*SHORT, "-m", "seed=1,2", "hydra.sweep.dir=mine"]) == 0
    assert states == [["running"], ["done", "running"]]


def test_job_refuses_a_used_folder(here):
    words = [*SHORT, "-m", "seed=1", "hydra.sweep.dir=mine"]
    assert train.main(words) == 0
    before = (here / "mine/0_default/metrics.jsonl").read_bytes()
    assert train.main(words) == 1
    (row,) = rows("mine")
    assert "is not empty" in row["state"] and "resume=mine/0_default" in row["state"]
    assert (here / "mine/0_default/metrics.jsonl").read_bytes() == before


def test_hydra_run_dir_is_the_folder(here, capsys):
    assert train.main([*SHORT, "hydra.run.dir=mine/first"]) == 0
    assert (here / "mine/first/checkpoints").is_dir()
    assert evaluate.main(["run=mine/first", "episodes=4", "hydra.run.dir=x"]) == 2
    assert "folder: no such key" in capsys.readouterr().err


@pytest.mark.slow
def test_wandb_group_of_a_sweep(here, monkeypatch):
    groups = []

    class Wandb:
        def __init__(self, group: str | None = None, mode: str = "online"):
            groups.append(group)

        def write(self, step, values): ...

        def close(self): ...

    monkeypatch.setattr("megastep.agents.training.loggers.wandb.Wandb", Wandb)
    own = [*SHORT, "logger=[csv,wandb]", "logger.wandb.mode=offline"]
    assert train.main([*own, "-m", "seed=1", "hydra.sweep.dir=mine"]) == 0
    typed = "logger.wandb.group=g"
    assert train.main([*own, "-m", "seed=1", "hydra.sweep.dir=x", typed]) == 0
    assert train.main([*own, "folder=alone"]) == 0
    assert groups == ["mine", "g", None]


# ---- Other launchers and sweepers ----

JOBLIB = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "hydra.sweep.dir=mine"]


def n_learning(here):
    return sum(path.stat().st_size > 0 for path in here.glob("mine/*/metrics.jsonl"))


@pytest.mark.slow
def test_signal_saves_jobs_in_other_processes(here):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    words = "samples=1e12", "env.mood=slow", "-m", "seed=1,2,3"
    process = start("train", *SMALL, *words, *JOBLIB)

    wait_until(lambda: n_learning(here) == 2, process)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=HUNG)
    assert process.returncode == 143 and err.splitlines()[-1] == "train.py: stopped by SIGTERM"
    assert [row["state"][:11] for row in rows("mine")] == ["interrupted", "interrupted"]
    assert len(list(here.glob("mine/*/checkpoints/step_*"))) == 2


@pytest.mark.slow
def test_optuna_maximises_and_skips_failed_trials(here):
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper")
    words = ["hydra/sweeper=optuna", "hydra.sweeper.n_trials=4", "hydra.sweeper.n_jobs=1"]
    words += ["hydra.sweeper.storage=sqlite:///study.db", "hydra.sweeper.study_name=pay"]
    words += ["hydra.sweeper.sampler.seed=1", "env.pay=interval(0.5,8.0)", "env.mood=fine,cross"]
    words += ["metric=eval/length", "finish.evaluate=true", "finish.episodes=4", "seed=1,2"]
    code = train.main([*SHORT, "-m", *words, "hydra.sweep.dir=mine"])
    table = rows("mine")
    assert [row["seed"] for row in table] == 4 * ["1", "2"] and (here / "study.db").exists()
    assert code == (1 if any(row["state"] != "done" for row in table) else 0)
    scores = [float(row["score"]) for row in table if row["score"]]
    assert scores and {*scores} == {4.0}, "the length of an episode, not its return"
    best = yaml.safe_load((here / "mine/optimization_results.yaml").read_text())
    assert best["best_value"] == max(scores)
    assert set(best["best_params"]) == {"env.pay", "env.mood"}


def test_a_job_is_the_mean_of_its_seeds(here, monkeypatch):
    job = sweeps.new_job(Composer(load("train")), here, "eval/return", ["seed=1", "seed=5"])
    monkeypatch.setattr(sweeps, "HydraConfig", SimpleNamespace(get=lambda: hydra))
    own = SimpleNamespace(num=3, config=SimpleNamespace(override_dirname=SimpleNamespace()))
    own.config.override_dirname.exclude_keys = []
    hydra = SimpleNamespace(job=own, overrides=SimpleNamespace(task=["env.pay=2"], hydra=[]))
    hydra.runtime = SimpleNamespace(output_dir="mine/3", choices={"hydra/launcher": "basic"})
    runs = []

    def run_once(self, row, words, is_joblib):
        runs.append((row["number"], row["folder"], words))
        return row | {"score": float(row["varied"]["seed"])}

    monkeypatch.setattr(sweeps.Job, "run_once", run_once)
    assert job(None) == 3.0
    assert runs == [(6 + i, f"mine/3_{s}", ["env.pay=2", s]) for i, s in enumerate(job.seeds)]


@pytest.mark.slow
def test_preempted_submitit_job_continues_its_checkpoint(here):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    total = f"samples={400 * UPDATE}"
    job = here / "mine/job"
    words = [*SMALL, "-m", "seed=1", total, "hydra/launcher=submitit_local", "hydra.sweep.dir=mine"]
    words += ["hydra.sweep.subdir=job"]
    process = start("train", *words, "checkpoints.seconds=0.2", cwd=here)
    wait_until(lambda: [*job.glob("checkpoints/step_*")], process)
    (row,) = (here / "mine/.jobs").glob("*/0.json")
    os.kill(json.loads(row.read_text())["process"], signal.SIGUSR2)
    _, err = process.communicate(timeout=HUNG)
    assert process.returncode == 0, err
    (row,) = rows("mine")
    assert row["state"] == "done"
    assert len((job / "provenance.jsonl").read_text().splitlines()) == 2, "it was started twice"
    assert train.main([*SMALL, "seed=1", total, "folder=whole"]) == 0
    metrics = (here / "whole/metrics.jsonl").read_bytes()
    assert metrics == (job / "metrics.jsonl").read_bytes()


@pytest.mark.slow
def test_job_that_ends_its_process_leaves_the_others(here):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    code, out, err = finished("train", *SHORT, "-m", "env.mood=dead,fine", "env.pay=2", *JOBLIB)
    assert code == 1 and f"Job 0 {sweeps.LOST}" in err and "Traceback" not in err
    dead, fine = rows("mine")
    assert (dead["state"], fine["state"], float(fine["score"])) == (sweeps.LOST, "done", 8)
    records = [json.loads(path.read_text()) for path in (here / "mine/.jobs").glob("*/*.json")]
    assert len({record["process"] for record in records}) == 2
    assert "job 1: Training on cpu in mine/1_env.mood=fine" in out


@pytest.mark.slow
def test_jobs_with_ranks_train_as_alone_and_a_lost_rank_fails_its_job_only(here):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    words = *SMALL, f"samples={4 * UPDATE}", "ranks=2", "env.pay=2"
    code, out, err = finished("train", *words, "-m", "env.mood=lost,fine", *JOBLIB)
    assert code == 1 and "rank 1 on " in err and "Traceback" not in err, err
    lost, fine = rows("mine")
    assert lost["state"].startswith("FAILED: rank 1 on ")
    assert fine["state"] == "done" and float(fine["score"]) == 8
    assert finished("train", *words, "folder=alone")[0] == 0
    metrics = (pathlib.Path(folder) / "metrics.jsonl" for folder in (fine["folder"], "alone"))
    assert len({path.read_bytes() for path in metrics}) == 1


# ---- Where jobs run ----


def test_values_are_those_of_the_device_where_the_job_runs(here, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    job = sweeps.new_job(Composer(load("train")), here)
    job = cloudpickle.loads(cloudpickle.dumps(job))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    composer = Composer(load(job.source[0]), *job.source[1:])
    for words, n_envs in ((["seed=1"], 4096), (["seed=1", "device=cpu"], 256)):
        assert composer.settings(words).env.n_envs == n_envs


@pytest.fixture
def gpus(here, monkeypatch):
    """Pretends that there are GPUs: a function that sets their number and returns a job's settings.
    Its `current` are the numbers given to `set_device`.
    """
    current = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "set_device", current.append)
    monkeypatch.setattr(tempfile, "tempdir", str(here))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)

    def settings(number, *words):
        monkeypatch.setattr(torch.cuda, "device_count", lambda: number)
        return Composer(load("train")).settings(words)

    settings.current = current
    return settings


def test_jobs_take_gpus_in_turn(gpus):
    for number in range(4):
        with gpu_slots.taken(gpus(3, "device=cuda"), number) as cfg:
            assert cfg.device == f"cuda:{number % 3}" and gpus.current[-1] == number % 3
    with gpu_slots.taken(gpus(3, "device=auto"), 2) as cfg:
        assert cfg.device == "auto" and gpus.current[-1] == 2
    gpus.current.clear()
    for n_gpus, word in ((1, "device=cuda"), (3, "device=cuda:2"), (3, "device=cpu")):
        with gpu_slots.taken(gpus(n_gpus, word), 1) as cfg:
            assert f"device={cfg.device}" == word and not gpus.current


def test_jobs_of_several_gpus(gpus):
    visible = []
    for number in range(3):
        with gpu_slots.taken(gpus(5, "ranks=2"), number):
            visible.append(os.environ["CUDA_VISIBLE_DEVICES"])
        assert "CUDA_VISIBLE_DEVICES" not in os.environ
    assert visible == ["0,1", "2,3", "0,1"]  # the fifth GPU stays idle


def test_ranks_see_the_gpus_of_their_place_only(gpus, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "6, 4,GPU-8a,3")
    for words, visible in (
        (["ranks=2"], "6,4"),
        (["ranks=all"], "6,4,GPU-8a,3"),
        (["ranks=2", "device=cpu"], "6, 4,GPU-8a,3"),
    ):
        with gpu_slots.taken(gpus(4, *words), 0):
            assert os.environ["CUDA_VISIBLE_DEVICES"] == visible
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "6, 4,GPU-8a,3" and not gpus.current


LOCAL, SLURM = ["hydra/launcher=submitit_local"], ["hydra/launcher=submitit_slurm"]


@pytest.mark.parametrize(
    "words, text",
    [
        (["ranks=8"], "ranks: 8 is more than the 4 GPUs of this machine"),
        (["ranks=2,5"], "ranks: 5 is more than the 4 GPUs of this machine"),
        (["ranks=2", "device=cuda:1"], "device: 'cuda:1' names one GPU"),
        ([*LOCAL, "ranks=5"], "ranks: 5 is more than the 4 GPUs of this machine"),
        ([*SLURM, "hydra.launcher.gpus_per_node=2", "ranks=4"], "ranks: 4 is more than hydra"),
        ([*SLURM, "hydra.launcher.nodes=2"], "hydra.launcher.nodes: 2 would run each job 2 times"),
    ],
)
def test_sweep_that_has_too_few_gpus(here, gpus, capsys, words, text):
    if any("submitit" in word for word in words):
        pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    gpus(4)
    assert train.main(["-m", "seed=1,2", *words]) == 2
    assert text in capsys.readouterr().err and not (here / "sweeps").exists()


# ---- Names and scores ----


def report(step, count, window, mean):
    """A line of metrics: `count` episodes ended, and `mean` is over `window`."""
    counts = {"samples": step, "episode/count": count}
    return counts | ({"episode/window": window, "episode/return": mean} if window else {})


def score(here, *lines):
    (here / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return scores.outcome(here)["score"]


def test_score_is_the_mean_over_the_episodes_of_the_last_reports(here):
    # ten reports of 100 n episodes each, after two that do not count
    lines = [report(n, 100 * n, 100 * n, float(n)) for n in range(1, 13)]
    assert score(here, *lines) == pytest.approx(
        sum(n * n for n in range(3, 13)) / sum(range(3, 13))
    )
    assert score(here, *[report(n, 0, 0, None) for n in range(3)]) is None
    (here / "empty").mkdir()
    assert scores.outcome(here / "empty")["score"] is None


# ---- --config-dir; completion ----


@pytest.mark.slow
def test_config_dir_and_config_name(here, capsys):
    files = {
        "env/mine.yaml": "name: payer:Payer\npay: 7\n",
        "size/small.yaml": "# @package _global_\nagent:\n  width: 8\n",
        "whole.yaml": "defaults:\n  - train\n  - override env: mine\n  - _self_\nseed: 5\n",
    }
    for name, text in files.items():
        (here / "conf" / name).parent.mkdir(parents=True, exist_ok=True)
        (here / "conf" / name).write_text(text)

    def printed(*words):
        assert train.main(["--config-dir", "conf", *words]) == 0
        return capsys.readouterr().out

    tree = yaml.safe_load(printed("env=mine", "+size=small", "--cfg", "job"))
    assert (tree["env"]["pay"], tree["agent"]["width"]) == (7, 8)
    tree = yaml.safe_load(printed("--config-name", "whole", "--cfg", "job"))
    assert (tree["env"]["pay"], tree["seed"]) == (7, 5)
    lines = printed("--help").splitlines()
    assert any(line.startswith("  env ") and " mine," in line for line in lines)
    assert any(line.split() == ["size", "small"] for line in lines)
    words = ["--config-dir", "conf", *SHORT[1:], "-m", "env=mine", "+size=small", "seed=1"]
    assert train.main([*words, "hydra.sweep.dir=mine"]) == 0
    assert float(rows("mine")[0]["score"]) == 28
    for words, message in (
        (["-cd", "conf", "env=mien"], "did you mean mine?"),
        (["-cd", "conf", "size=small"], "+size=small"),
        (["-cd", "conf", "+siz=small"], "siz: no such key; did you mean size?"),
        (["-cd", "nowhere"], "There is no folder nowhere"),
        (["-cn", "nowhere"], "nowhere: is in none of the folders"),
    ):
        assert train.main(words) == 2
        assert message in capsys.readouterr().err
