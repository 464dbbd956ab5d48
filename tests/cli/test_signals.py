"""Signals at every moment of a run: the exit code is 128 + the number, and nothing is lost."""

import contextlib
import itertools
import json
import os
import pathlib
import signal
import subprocess
import sys
import time

import pytest

from megastep import recording
from megastep.agents.cli import train
from megastep.agents.evaluation import playing
from megastep.agents.factory import make as factory
from megastep.agents.launch import signals
from megastep.agents.runs import checkpoint, folders, provenance
from megastep.agents.storage.collector import Collector
from megastep.agents.training import loggers
from tests.helpers import tiny
from tests.helpers.processes import HUNG, Forked, start, wait_until

TINY = [*tiny.TINY, "logging.every=1"]
UPDATE = tiny.UPDATE
WHOLE = ["finish.evaluate=true", "finish.episodes=4", "finish.record=true", "finish.steps=3"]
SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def pairs(moments):
    """Each moment with one of the signals in turn."""
    return [*zip(moments, itertools.cycle(SIGNALS))]


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """Changes to an empty folder, with default signal handlers."""
    monkeypatch.chdir(tmp_path)
    before = {number: signal.signal(number, signal.SIG_DFL) for number in signals.SIGNALS}
    yield tmp_path
    for number, handler in before.items():
        signal.signal(number, handler)


def signalled(monkeypatch, owner, name, *numbers, call=2):
    """From now on the `call`-th call of `owner.name` gets the signals in its middle: after its
    work, before it returns.
    """
    real, calls = getattr(owner, name), []

    def interrupted(*arguments, **options):
        result = real(*arguments, **options)
        calls.append(1)
        if len(calls) == call:
            for number in numbers:
                os.kill(os.getpid(), number)
        return result

    monkeypatch.setattr(owner, name, interrupted)


def composing(monkeypatch, number):
    from omegaconf import DictConfig

    signalled(monkeypatch, DictConfig, "_validate_set", number, call=20)


IMPORTING = """
import importlib.machinery, os, signal, sys, types
from megastep.agents.launch import signals
signals.exit_on_signals("train")
sys.modules["torch"] = torch = types.ModuleType("torch")
torch.__spec__ = importlib.machinery.ModuleSpec("torch", None)
torch.__spec__._initializing = True
with signals.interrupting():
    os.kill(os.getpid(), signal.SIGINT)
"""


def test_a_signal_while_torch_is_imported_ends_the_process_at_once():
    """An exception there would abort it, where C++ imports."""
    ended = subprocess.run([sys.executable, "-c", IMPORTING], capture_output=True, text=True)
    assert ended.returncode == 130, ended.stderr
    assert ended.stderr.endswith(": stopped by SIGINT\n")


def importing(monkeypatch, number):
    """A library swallows the interruption, and fails on what it imported in part."""

    def swallowed(*arguments):
        with contextlib.suppress(BaseException):
            os.kill(os.getpid(), number)
        raise AttributeError("module has no attribute")

    monkeypatch.setattr(factory, "make_policy", swallowed)


def swallowing(monkeypatch, number):
    def swallowed(*arguments):
        with contextlib.suppress(BaseException):
            os.kill(os.getpid(), number)

    monkeypatch.setattr(train.COMMAND, "run", swallowed)


def making_a_folder(monkeypatch, number):
    signalled(monkeypatch, folders, "new", number, call=1)


def noting_the_start(monkeypatch, number):
    signalled(monkeypatch, provenance, "record", number, call=1)


BEFORE_TRAINING = [composing, making_a_folder, noting_the_start, importing, swallowing]


@pytest.mark.parametrize("moment, number", pairs(BEFORE_TRAINING))
def test_signal_before_training(here, monkeypatch, capsys, moment, number):
    moment(monkeypatch, number)
    assert train.main([*TINY, "samples=1e9", "folder=run"]) == 128 + number
    assert capsys.readouterr().err == f"train.py: stopped by {number.name}\n"
    assert not (here / "run").exists()


def collecting(monkeypatch, number):
    signalled(monkeypatch, Collector, "__call__", number)


def reporting(monkeypatch, number):
    signalled(monkeypatch, loggers.Loggers, "write", number)


def saving(monkeypatch, number):
    # in the second checkpoint, which is written while training goes on
    signalled(monkeypatch, checkpoint, "save_tensors", number, call=3)


@pytest.mark.parametrize(
    "numbers",
    [
        [signal.SIGUSR1],
        [signal.SIGUSR2, signal.SIGTERM],
        [signal.SIGUSR2, signal.SIGUSR2],
        [signal.SIGTERM, signal.SIGUSR1],
    ],
)
def test_signals_of_a_cluster_save_and_do_not_quit(here, monkeypatch, numbers):
    monkeypatch.setattr(signals, "SAME", -1)  # any signal that repeats another does so at once
    signalled(monkeypatch, Collector, "__call__", *numbers)
    assert train.main([*TINY, "samples=1e9", "folder=run"]) == 128 + numbers[0]
    assert checkpoint.load_latest(here / "run" / "checkpoints").step == 2 * UPDATE


@pytest.mark.parametrize("moment, number", pairs([collecting, reporting, saving]))
def test_signal_while_training(here, monkeypatch, capsys, moment, number):
    moment(monkeypatch, number)
    words = "samples=1e9", "folder=run", "checkpoints.seconds=1e-9"
    assert train.main([*TINY, *words]) == 128 + number
    step = checkpoint.load_latest(here / "run" / "checkpoints").step
    if moment is saving:  # while the second checkpoint is written, any number of updates go by
        assert step >= 2 * UPDATE and step % UPDATE == 0
    else:
        assert step == 2 * UPDATE
    expected = f"train.py: Stopped after {step} samples. To continue: python train.py resume=run\n"
    assert capsys.readouterr().err == expected
    assert not list((here / "run" / "checkpoints").glob("*tmp*"))
    assert not (here / "run" / "lock").exists()


def evaluating(monkeypatch, number):
    signalled(monkeypatch, playing, "first_episodes", number, call=1)


def filming(monkeypatch, number):
    signalled(monkeypatch, recording.Mp4Writer, "add", number)


# filming, which is slow, gets the others in test_record.py
@pytest.mark.parametrize("moment, number", [*pairs([evaluating]), (filming, signal.SIGHUP)])
def test_signal_after_training(here, monkeypatch, capsys, moment, number):
    moment(monkeypatch, number)
    assert train.main([*TINY, f"samples={UPDATE}", "folder=run", *WHOLE]) == 128 + number
    assert capsys.readouterr().err == f"train.py: stopped by {number.name}\n"
    assert checkpoint.load_latest(here / "run" / "checkpoints").step == UPDATE
    assert not list((here / "run").glob("*.mp4")) and not list((here / "run").glob(".*"))


def test_signal_stops_a_sweep(here, monkeypatch, capsys):
    signalled(monkeypatch, Collector, "__call__", signal.SIGTERM, call=2)
    assert train.main([*TINY, "-m", f"samples={UPDATE}", "seed=1,2,3"]) == 143
    table = capsys.readouterr().out.split("Sweep", 1)[1]
    assert "done" in table and "interrupted: Stopped after 32 samples" in table
    (folder,) = (here / "sweeps").iterdir()
    assert len((folder / "sweep.csv").read_text().splitlines()) == 3  # the third never began


def test_double_signal_counts_once(here, monkeypatch):
    """coreutils' timeout sends two, and so do a shell and the system when a terminal is closed."""
    monkeypatch.setattr(signals, "SAME", 3600)  # seconds: the second one is never late
    signalled(monkeypatch, Collector, "__call__", signal.SIGTERM, signal.SIGTERM)
    assert train.main([*TINY, "samples=1e9", "folder=run"]) == 143
    assert checkpoint.load_latest(here / "run" / "checkpoints").step == 2 * UPDATE


def test_nohup(here, monkeypatch):
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signalled(monkeypatch, Collector, "__call__", signal.SIGHUP)
    assert train.main([*TINY, f"samples={4 * UPDATE}", "folder=run"]) == 0
    assert checkpoint.load_latest(here / "run" / "checkpoints").step == 4 * UPDATE


# ---- In their own processes ----

STUCK = """
import os, signal, sys, time
from megastep.agents.training import loggers
from megastep.agents.cli import train

real = loggers.Loggers.write

def write(self, step, *values):
    real(self, step, *values)
    if step > int(os.environ["STUCK_AFTER"]):
        print("stuck", flush=True)
        while True:  # a signal just before a long sleep would be handled only after it
            time.sleep(0.1)

loggers.Loggers.write = write
sys.exit(train.main(sys.argv[1:]))
"""


def test_second_signal_quits(here, number=signal.SIGTERM):
    words = [*TINY, "samples=1e9", "folder=run", "checkpoints.seconds=1e-9"]
    (here / "stuck.py").write_text(STUCK)
    environment = {**os.environ, "STUCK_AFTER": str(2 * UPDATE)}
    process = Forked([here / "stuck.py", *words], here, environment)
    wait_until(lambda: "stuck" in process.written(), process)
    process.send_signal(number)
    wait_until(lambda: "again" in process.written(), process)
    time.sleep(0.5)
    process.send_signal(number)
    assert process.wait(timeout=HUNG) == 128 + number
    assert checkpoint.load_latest(here / "run" / "checkpoints").step in (UPDATE, 2 * UPDATE)
    assert train.main(["resume=run", f"samples={4 * UPDATE}"]) == 0, "nothing is corrupt"
    rows = (here / "run" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(row)["updates"] for row in rows] == [1, 2, 3, 4]


def is_caught(process, number):
    """Returns True if a process handles a signal."""
    status = pathlib.Path(f"/proc/{process.pid}/status").read_text()
    (mask,) = (line.split()[1] for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(mask, 16) >> number - 1 & 1)


def test_signal_during_imports(here, number=signal.SIGINT):
    process = start("train", *TINY, "samples=1e9")
    wait_until(lambda: is_caught(process, signal.SIGTERM) and is_caught(process, number), process)
    process.send_signal(number)
    out, err = process.communicate(timeout=HUNG)
    assert process.returncode == 128 + number and out == ""
    assert err == f"train.py: stopped by {number.name}\n"
    assert not any(here.iterdir())
