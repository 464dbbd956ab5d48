"""The scripts in their own processes: exit codes, signals, closed pipes."""

import json
import os
import signal
import subprocess
import sys

import pytest
import torch

from megastep.agents.cli import train
from megastep.agents.runs import checkpoint
from tests.helpers import tiny
from tests.helpers.processes import HUNG, ROOT, forked, start, wait_until

TINY = [*tiny.TINY, "checkpoints.seconds=0.2"]


def test_missing_gpu(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    assert train.main([*TINY, "device=cuda"]) == 2
    err = capsys.readouterr().err
    assert "device=cpu" in err and len(err.splitlines()) == 1
    assert not any(tmp_path.glob("runs/*"))
    assert train.main([*TINY, "device=auto", "samples=1", "folder=run"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == "Training on cpu in run"


@pytest.mark.slow
def test_missing_compiler(tmp_path):
    caches = dict.fromkeys(("XDG_CACHE_HOME", "MEGASTEP_CACHE"), str(tmp_path / "cache"))
    process = forked("train", *TINY, cwd=tmp_path, CXX="/nonexistent", **caches)
    _, err = process.communicate(timeout=HUNG)
    assert process.returncode == 2 and "compiler" in err and len(err.splitlines()) == 1
    assert not any(tmp_path.glob("runs/*"))


@pytest.mark.slow
def test_same_seed_in_two_processes(tmp_path):
    words = [*TINY, *tiny.SHORT_EPISODES, "samples=256", "logging.every=2"]
    metrics, weights = [], []
    for n, (begin, seed) in enumerate([(start, 1), (forked, 1), (forked, 2)]):  # hashes differ
        process = begin("train", *words, f"seed={seed}", f"folder=run{n}", cwd=tmp_path)
        assert process.communicate(timeout=HUNG)[1] == "" and process.returncode == 0
        metrics.append((tmp_path / f"run{n}" / "metrics.jsonl").read_bytes())
        weights.append(checkpoint.load_latest(tmp_path / f"run{n}" / "checkpoints").state["policy"])
    assert metrics[0] == metrics[1] != metrics[2] and len(metrics[0].splitlines()) == 4
    same, other = (
        [torch.equal(value, those[key]) for key, value in weights[0].items()]
        for those in weights[1:]
    )
    assert all(same) and not all(other)


def test_run_folder_lock_and_closed_terminal(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    process, metrics = forked("train", *TINY, "folder=run"), tmp_path / "run/metrics.jsonl"
    wait_until(lambda: metrics.exists() and metrics.stat().st_size, process)
    wait_until(lambda: any((tmp_path / "run" / "checkpoints").glob("step_*")), process)
    assert train.main(["resume=run"]) == 2
    err = capsys.readouterr().err
    assert f"in use by process {process.pid}" in err and len(err.splitlines()) == 1
    process.send_signal(signal.SIGHUP)
    _, err = process.communicate(timeout=HUNG)
    assert process.returncode == 129
    assert "python train.py resume=run" in err and "Traceback" not in err
    rows = [json.loads(line)["samples"] for line in metrics.read_text().splitlines()]
    assert rows == sorted(set(rows)), "no row twice"
    saved = checkpoint.load_latest(tmp_path / "run" / "checkpoints")
    assert saved.step >= rows[-1] and saved.path.name == f"step_{saved.step}"


@pytest.mark.parametrize(
    "redirection",
    [
        pytest.param(">&- 2>/dev/full", marks=pytest.mark.slow),
        pytest.param(">/dev/full 2>&-", marks=pytest.mark.nightly),
    ],
)
def test_run_continues_without_output(tmp_path, redirection):
    overrides = [*TINY, "samples=64", "folder=run", "finish.evaluate=true", "finish.episodes=4"]
    command = f"{{ {sys.executable} {ROOT / 'train.py'} {' '.join(overrides)}; echo $? >code; }}"
    subprocess.run(
        ["bash", "-c", f"{command} {redirection}"],
        cwd=tmp_path,
        timeout=HUNG,
        env={**os.environ, "TERM": "dumb"},
    )
    assert (tmp_path / "code").read_text() == "0\n"
    assert list((tmp_path / "run" / "evaluations").glob("box-test-*.json"))
    for name in ("metrics.jsonl", "perf.jsonl"):  # no line of stdout's is in a file
        assert all(json.loads(line) for line in (tmp_path / "run" / name).read_text().splitlines())
    assert checkpoint.load_latest(tmp_path / "run" / "checkpoints").step == 64
