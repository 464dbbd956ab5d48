"""Trainers of other projects beside megastep's. Theirs run only where they are installed."""

import argparse
import json
import subprocess
import sys

import benchmark
import paths
import peers
import pytest

ADAPTERS = paths.ROOT / "scripts" / "benchmarks" / "peers"
SMALL = "geometry=box", "env.res=16"


@pytest.fixture
def explorer(monkeypatch):
    monkeypatch.syspath_prepend(str(ADAPTERS))
    return pytest.importorskip("explorer")


def test_a_missing_trainer_is_named(monkeypatch, capsys):
    trainers = [("absent", "no_such_module", "no-such-package==1.0", ("float32",))]
    monkeypatch.setattr(peers, "TRAINERS", trainers)
    assert benchmark.main(["peers", "--device", "cpu", "--commit", "abc"]) == 2
    message = "no_such_module is not installed: pip install no-such-package==1.0"
    assert capsys.readouterr().err == f"benchmark.py: {message}\n"


def test_laps_have_the_samples_between_two_times(explorer, monkeypatch, tmp_path):
    now, n_samples = 0.0, 0
    monkeypatch.setattr(explorer.time, "perf_counter", lambda: now)
    given = argparse.Namespace(device="cpu", lap_seconds=3.0, result=tmp_path / "rates")
    clock = explorer.Clock(given)
    n_iterations = 0
    while not clock.is_done(n_samples):
        n_iterations += 1
        now += 100.0 if n_iterations <= explorer.N_WARM_UPS else 2.0
        n_samples += 10
    # a lap ends after the first iteration that reaches 3 seconds
    assert json.loads(given.result.read_text()) == [20 / 4] * explorer.N_LAPS
    assert n_iterations == explorer.N_WARM_UPS + 2 * explorer.N_LAPS


@pytest.mark.slow
@pytest.mark.parametrize("name", ["megastep", "pufferlib", "rsl_rl"])
def test_trainers_train(name, tmp_path):
    pytest.importorskip(name)
    result = tmp_path / "rates.json"
    command = [sys.executable, ADAPTERS / f"with_{name}.py", "--device=cpu", "--lanes=16"]
    command += ["--lap-seconds=0.1", f"--result={result}", *SMALL]
    subprocess.run(command, cwd=tmp_path, check=True)
    rates = json.loads(result.read_text())
    assert len(rates) == 5 and min(rates) > 0
