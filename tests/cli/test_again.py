"""`resume=auto`: one command that starts a run and continues it."""

import shutil
import signal
from pathlib import Path

import pytest

from megastep.agents.cli import command, train
from megastep.agents.launch import again
from megastep.agents.runs import checkpoint
from megastep.agents.storage.collector import Collector
from tests.helpers.tiny import TINY, UPDATE

RUN = [*TINY, "logging.every=1", f"samples={6 * UPDATE}"]
AUTO = [*RUN, "folder=run", "resume=auto"]


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(again.SLURM_JOB, raising=False)
    return tmp_path


def stop_after(monkeypatch, n):
    """Has training stop in its nth update, as by a cluster's signal. Returns the patch."""
    real, calls = Collector.__call__, []

    def call(*arguments, **options):
        calls.append(1)
        if len(calls) == n:
            signal.raise_signal(signal.SIGUSR1)
        return real(*arguments, **options)

    monkeypatch.setattr(Collector, "__call__", call)


def test_one_command_starts_continues_and_is_done(monkeypatch, capsys):
    assert train.main([*RUN, "folder=whole"]) == 0
    with monkeypatch.context() as patch:
        stop_after(patch, 3)
        assert train.main(AUTO) == 128 + signal.SIGUSR1
    assert checkpoint.load_latest("run/checkpoints").step == 3 * UPDATE
    assert train.main(AUTO) == 0
    metrics = Path("run/metrics.jsonl").read_bytes()
    assert metrics == Path("whole/metrics.jsonl").read_bytes()
    capsys.readouterr()
    assert train.main(AUTO) == 0
    assert "has already used up its budget" in capsys.readouterr().out
    assert metrics == Path("run/metrics.jsonl").read_bytes()
    longer = [f"samples={8 * UPDATE}" if "samples=" in word else word for word in AUTO]
    assert train.main(longer) == 0
    assert checkpoint.load_latest("run/checkpoints").step == 8 * UPDATE


def test_other_settings_and_other_folders_are_refused(monkeypatch, capsys):
    assert train.main(AUTO) == 0
    metrics = Path("run/metrics.jsonl").read_bytes()
    for words, text in (
        ([*AUTO, "learner.lr=0.5", "seed=7"], "learner.lr: was"),
        ([*AUTO, "learner.lr=0.5", "seed=7"], "seed: was 1 when the run began"),
        ([*AUTO, "more_samples=9"], "with resume=auto give the total, samples="),
        ([*RUN, "resume=auto"], "folder: is needed with resume=auto"),
        ([*AUTO, "rerun=run"], "cannot be combined"),
    ):
        assert train.main(words) == 2
        assert text in capsys.readouterr().err
    Path("mine").mkdir()
    Path("mine/file").touch()
    assert train.main([*RUN, "folder=mine", "resume=auto"]) == 2
    assert "is not empty" in capsys.readouterr().err and [*Path("mine").iterdir()]
    assert Path("run/metrics.jsonl").read_bytes() == metrics


def test_a_run_that_saved_nothing_begins_again_and_a_damaged_one_does_not(capsys):
    assert train.main(AUTO) == 0
    metrics = Path("run/metrics.jsonl").read_bytes()
    shutil.rmtree("run/checkpoints")
    assert train.main(AUTO) == 0
    assert Path("run/metrics.jsonl").read_bytes() == metrics
    for path in Path("run/checkpoints").glob("*/state.pt"):
        path.write_bytes(b"")
    assert train.main(AUTO) == 2
    assert "is damaged" in capsys.readouterr().err


def test_job_of_slurm_names_the_folder(monkeypatch):
    monkeypatch.setenv(again.SLURM_JOB, "71_2")
    for _ in range(2):
        assert train.main([*RUN, "resume=auto"]) == 0
    assert [path.name for path in Path("runs").iterdir() if path.is_dir()] == ["slurm-71_2"]


def test_words_of_wandbs_agents():
    for word in ("--learner.lr=0.1", "--env=pong", "--agent.core=lstm", "--seed=3"):
        assert command.without_dashes(word) == word[2:]
    for word in ("--cfg=job", "--help", "seed=--3", "-m"):
        assert command.without_dashes(word) == word
    words = [f"--{word}" if "=" in word else word for word in TINY]
    assert train.main([*words, "--samples=32", "--folder=run"]) == 0
