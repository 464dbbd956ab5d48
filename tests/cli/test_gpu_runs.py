"""On a GPU, what a user does: train, interrupt, resume, start from weights, evaluate, film; in this
process and in seconds. What a run leaves, and how it fails, is in test_train.py, on the CPU.
"""

import os
import shutil
import signal

import pytest
import torch

from megastep import capture
from megastep.agents.algorithms.nonfinite import nonfinite_leaf
from megastep.agents.cli import train
from megastep.agents.runs import checkpoint, json_lines
from megastep.agents.training import loggers
from tests.helpers import tiny
from tests.helpers.weights import of_run as weights

pytestmark = pytest.mark.cuda

TINY = [*tiny.ON_GPU, "logging.every=1"]
UPDATE = tiny.UPDATE_ON_GPU
STOPPED = 6 * UPDATE


def rows(folder):
    return json_lines.read(folder / "metrics.jsonl")


def train_until_interrupted(folder, *words):
    """Trains until Ctrl-C after six updates: two warm up a CUDA graph, the third captures it."""
    write = loggers.Loggers.write

    def interrupting(self, step, *values):
        write(self, step, *values)
        if step == STOPPED:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loggers.Loggers, "write", interrupting)
        patch.chdir(folder)
        assert train.main([*TINY, *words, "folder=run"]) == 130
    return folder / "run"


@pytest.fixture(scope="module")
def stopped_once(tmp_path_factory):
    return train_until_interrupted(tmp_path_factory.mktemp("runs"))


@pytest.fixture
def stopped(stopped_once, tmp_path):
    """A copy of one interrupted run, for a test to continue."""
    return shutil.copytree(stopped_once, tmp_path / "stopped")


def is_captured(trainer):
    """Returns True if collecting and updating replayed CUDA graphs."""
    is_updated = trainer.learner.cuda_graph.graph is not None
    return is_updated and isinstance(trainer.collect.graph, capture.Graph)


def test_resumed_run_uses_cuda_graphs(stopped, trainers):
    before = weights(stopped)
    assert train.main([f"resume={stopped}", f"samples={2 * STOPPED}"]) == 0
    (trainer,) = trainers
    assert is_captured(trainer) and trainer.policy.device.type == "cuda"
    assert (trainer.samples, trainer.updates) == (2 * STOPPED, 12)
    reports = rows(stopped)
    assert [row["updates"] for row in reports] == list(range(1, 13))
    assert all(row["loss/skipped_steps"] == 0 and row["loss/value"] >= 0 for row in reports)
    after = weights(stopped)
    assert any(not torch.equal(after[name], before[name]) for name in after)
    assert trainer.nonfinite_guard.value is None
    assert trainer.env.core.agents.positions.isfinite().all()
    assert checkpoint.load_latest(stopped / "checkpoints").step == 2 * STOPPED


def test_resume_on_another_device(stopped, capsys):
    """On the GPU again, then on the CPU, then back on the GPU."""
    for i, (device, moves) in enumerate([("cuda", False), ("cpu", True), ("cuda", True)], 1):
        samples = STOPPED + 4 * i * UPDATE
        assert train.main([f"resume={stopped}", f"device={device}", f"samples={samples}"]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert any("not bit for bit" in line and "device was" in line for line in lines) == moves
        assert checkpoint.load_latest(stopped / "checkpoints").step == samples


def test_non_finite_reward_in_a_cuda_graph(monkeypatch, tmp_path, capsys, trainers):
    # captured in the graph: the reward of lane 5 is NaN at every step
    from megastep import envs

    real = envs.Explorer.step

    def step(self, decision):
        world = real(self, decision)
        world.reward[5].fill_(float("nan"))  # an assignment would copy from the host
        return world

    monkeypatch.setattr(envs.Explorer, "step", step)
    monkeypatch.chdir(tmp_path)
    assert train.main([*TINY, "folder=run", "samples=10_000_000", "logging.every=10"]) == 1
    sentence = capsys.readouterr().err.splitlines()[-1]
    assert "The last 20 updates were skipped" in sentence
    assert "reward of lane 5 was nan" in sentence and is_captured(trainers[0])
    assert nonfinite_leaf(checkpoint.load_latest(tmp_path / "run" / "checkpoints").state) is None
