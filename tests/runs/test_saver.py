"""The saver: a thread writes while training goes on. Some checkpoints have large replay buffers."""

import threading

import pytest
import torch

from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.runs import checkpoint, saver


@pytest.fixture
def writes(tmp_path):
    return saver.Saver(tmp_path, {}, keep_checkpoints=9, replay_every=3)


def state(replay_value=1.0):
    replay = {"rows": torch.full((1000,), replay_value)}
    return {
        "policy": {"w": torch.zeros(3)},
        "env": {"x": torch.tensor(torch.inf)},
        "replay": replay,
    }


def test_training_goes_on_while_a_checkpoint_is_written(writes, tmp_path, monkeypatch):
    may_write, save = threading.Event(), checkpoint.save
    monkeypatch.setattr(checkpoint, "save", lambda *args: may_write.wait() and save(*args))
    mine = state()
    writes(1, mine)
    mine["policy"]["w"] += 1  # training changes what is being written
    assert not checkpoint.list_checkpoints(tmp_path)
    may_write.set()
    writes.wait()
    assert writes.error is None
    loaded = checkpoint.load_latest(tmp_path).state
    assert not loaded["policy"]["w"].any() and loaded["env"]["x"] == torch.inf


def test_what_was_learnt_must_be_finite(writes, tmp_path):
    with pytest.raises(NonFiniteError, match="policy.w is not finite"):
        writes(1, {"policy": {"w": torch.tensor(torch.nan)}})
    writes.wait()
    assert not checkpoint.list_checkpoints(tmp_path)


def test_errors_that_are_not_the_disks_are_raised(writes, monkeypatch):
    monkeypatch.setattr(checkpoint, "save", lambda *_: 1 / 0)
    writes(1, state())
    with pytest.raises(ZeroDivisionError):
        writes.wait()


def with_replay(folder):
    paths = checkpoint.list_checkpoints(folder)
    return [checkpoint.step_of(path) for path in paths if (path / "replay.pt").exists()]


def test_small_replay_buffer_is_in_every_checkpoint(writes, tmp_path):
    for step in range(1, 4):
        writes(step, state())
    writes.wait()
    assert with_replay(tmp_path) == [1, 2, 3] and not writes.lacks_replay


def test_large_replay_buffer_is_in_some_checkpoints_and_the_last(writes, tmp_path, monkeypatch):
    monkeypatch.setattr(saver, "SMALL_REPLAY", 100)
    for step in range(1, 9):
        writes(step, state(), is_last=step == 8)
        assert writes.lacks_replay == (step not in (3, 6, 8))
    writes.wait()
    assert with_replay(tmp_path) == [3, 6, 8]
    assert checkpoint.load_latest(tmp_path / "step_6").state["replay"]["rows"].all()
    assert "replay" not in checkpoint.load_latest(tmp_path / "step_7").state


def test_checkpoint_after_one_that_failed_has_the_replay_buffer(writes, tmp_path, monkeypatch):
    monkeypatch.setattr(saver, "SMALL_REPLAY", 100)
    with monkeypatch.context() as patch, pytest.warns(UserWarning, match="tries again") as warned:
        patch.setattr(checkpoint, "save", lambda *_: open(tmp_path / "no folder" / "file"))
        for step in (1, 2):
            writes(step, state())
            writes.wait()
            assert writes.error.startswith(f"The checkpoint at {step} samples could not be saved")
    assert len(warned) == 1
    for step in (3, 4):
        writes(step, state())
    writes.wait()
    assert with_replay(tmp_path) == [3] and writes.error is None


def test_checkpoint_with_a_large_replay_buffer_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(saver, "SMALL_REPLAY", 100)
    writes = saver.Saver(tmp_path, {}, keep_checkpoints=2, replay_every=4)
    for step in range(1, 8):
        writes(step, state())
    writes.wait()
    assert with_replay(tmp_path) == [4]
    assert [checkpoint.step_of(p) for p in checkpoint.list_checkpoints(tmp_path)] == [4, 6, 7]


def test_replay_buffer_that_would_delay_the_end_is_left_out(writes, tmp_path, monkeypatch):
    monkeypatch.setattr(saver, "SMALL_REPLAY", 100)
    monkeypatch.setattr(saver, "LAST_REPLAY", 200)
    writes(1, state(), is_last=True)
    writes.wait()
    assert writes.error is None and with_replay(tmp_path) == []
    assert "replay" not in checkpoint.load_latest(tmp_path).state
    assert sorted(path.name for path in (tmp_path / "step_1").iterdir()) == [
        "config.json",
        "manifest.json",
        "state.pt",
        "world.pt",
    ]
