"""A run's NaN, replayed by the command that its last sentence names."""

import shlex
import shutil
import sys

import pytest
import torch

from megastep import envs
from megastep.agents.cli import entry, replay, train
from tests.helpers import tiny

TINY = [*tiny.TINY, *tiny.SHORT_EPISODES]


def with_fault(real):
    """Lane 2 earns a huge number made of its place, in its third episode and later."""

    def step(self, decision):
        world = real(self, decision)
        is_late = (self.spawner.counts[:, 0] >= 3) & (torch.arange(4, device=self.device) == 2)
        is_bad = is_late & (self.lifecycle.ages >= 2)
        reward = 1e13 * self.core.agents.positions[:, 0, 0]
        return type(world)(world, reward=torch.where(is_bad, reward, world.reward))

    return step


def call(monkeypatch, *words):
    """Returns the exit code of `python -m megastep` with these words."""
    monkeypatch.setattr(sys, "argv", ["/megastep/__main__.py", *words])
    return entry.main()


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_the_command_of_the_last_sentence_shows_the_number_again(
    tmp_path, monkeypatch, capsys, device
):
    monkeypatch.chdir(tmp_path)
    real = envs.Minimal.step
    monkeypatch.setattr(envs.Minimal, "step", with_fault(real))
    words = [*TINY, f"samples={20 * tiny.UPDATE}", "folder=run", "log_every=6", f"device={device}"]
    assert train.main(words) == 1
    warning, sentence = capsys.readouterr().err.splitlines()
    sentence, command = sentence.split(". To see it again: ")
    assert warning.endswith(command)
    _, _, module, *replay_words = shlex.split(command)
    assert module == "megastep" and call(monkeypatch, *replay_words) == 0
    number = sentence.partition("train.py: ")[2].partition(". All else")[0]
    assert number.startswith("reward of lane 2 was ") and number.count(" at step ") == 1
    shown = capsys.readouterr().out.strip()
    assert shown.startswith(f"As in the run, on {device}") and shown.endswith(f": {number}")

    monkeypatch.setattr(envs.Minimal, "step", real)
    assert call(monkeypatch, *replay_words, f"device={device}") == 1
    (sentence,) = capsys.readouterr().err.splitlines()
    assert "all numbers were finite; in the run, reward of lane 2 was not" in sentence

    shutil.rmtree(tmp_path / "run" / "checkpoints")
    assert call(monkeypatch, *replay_words) == 2
    (sentence,) = capsys.readouterr().err.splitlines()
    assert "There is no checkpoint in run" in sentence


def test_a_run_with_a_curriculum_is_replayed_in_the_homes_that_it_drew(
    tmp_path, monkeypatch, capsys
):
    """There are as many homes as environments; the bad episode begins in the recorded rollout."""
    monkeypatch.chdir(tmp_path)
    real = envs.PointGoal.step

    def step(self, decision):
        world = real(self, decision)
        is_bad = (self.spawner.counts[:, 0] >= 12) & (torch.arange(4) == 2) & (self.ages >= 2)
        reward = 1e13 * (self.layout + 1) + 1e12 * self.core.agents.positions[:, 0, 0]
        return type(world)(world, reward=torch.where(is_bad, reward, world.reward))

    monkeypatch.setattr(envs.PointGoal, "step", step)
    words = [*tiny.TINY, "env=pointgoal", "env.limit=3", "geometry=bench", "geometry.n=4"]
    words += ["curriculum=plr", "curriculum.temperature=0.2", f"samples={20 * tiny.UPDATE}"]
    assert train.main([*words, "folder=run", "log_every=1"]) == 1
    sentence, command = capsys.readouterr().err.splitlines()[-1].split(". To see it again: ")
    assert call(monkeypatch, *shlex.split(command)[3:]) == 0
    number = sentence.partition("train.py: ")[2].partition(". All else")[0]
    assert capsys.readouterr().out.strip().endswith(f": {number}")


@pytest.mark.parametrize("words", [["nothing.npz"], ["config.yaml"], []])
def test_what_cannot_be_replayed(tmp_path, monkeypatch, capsys, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.yaml").write_text("seed: 1")
    assert replay.main(words) == 2
    assert "Traceback" not in (text := capsys.readouterr().err)
    assert text.count("\n") == 1 or "usage:" in text


def test_without_the_copy_no_file_is_written(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(envs.Minimal, "step", with_fault(envs.Minimal.step))
    words = [*TINY, f"samples={8 * tiny.UPDATE}", "folder=run", "nonfinite_replay=false"]
    assert train.main(words) == 1
    assert "again" not in capsys.readouterr().err and not list(tmp_path.glob("run/*.npz"))
