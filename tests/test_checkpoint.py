"""Checkpoints: whole or absent, and damage is named. The damage here is done for real, to files on
the disk.
"""

import errno
import json
import os
import pickle
import subprocess
import sys

import pytest
import torch

from agents import checkpoint
from agents.checkpoint import CheckpointError

CONFIG = {"env": {"name": "box"}}


def state(n):
    return {
        "weights": {"w": torch.full((1000,), float(n))},
        "samples": n,
        "rate": 0.5,
        "none": None,
        "list": [1, 2],
    }


@pytest.fixture
def folder(tmp_path):
    """Three checkpoints, of steps 10, 20 and 30."""
    for n in (10, 20, 30):
        checkpoint.save(tmp_path, n, state(n), CONFIG, keep=3)
    return tmp_path


def names(folder):
    return [path.name for path in checkpoint.checkpoints(folder)]


def test_what_was_saved_is_loaded(folder):
    loaded = checkpoint.load(folder)
    assert loaded.step == 30 and loaded.config == CONFIG and loaded.path == folder / "step_30"
    assert torch.equal(loaded.state.pop("weights")["w"], torch.full((1000,), 30.0))
    assert loaded.state == {"samples": 30, "rate": 0.5, "none": None, "list": [1, 2]}


def test_one_checkpoint_can_be_chosen(folder):
    assert checkpoint.load(folder / "step_10").step == 10


def test_steps_are_ordered_as_numbers(tmp_path):
    for n in (9, 100, 20):
        checkpoint.save(tmp_path, n, state(n), CONFIG, keep=9)
    assert names(tmp_path) == ["step_9", "step_20", "step_100"]


@pytest.mark.parametrize("fraction", [0, 0.1, 0.5, 0.99])
@pytest.mark.parametrize("file", ["state.pt", "config.json", "manifest.json"])
def test_a_truncated_file_is_named_and_the_checkpoint_before_is_used(folder, file, fraction):
    path = folder / "step_30" / file
    os.truncate(path, int(fraction * path.stat().st_size))
    with pytest.warns(UserWarning, match=f"step_30 is damaged: {file}.*using step_20"):
        assert checkpoint.load(folder).step == 20


def test_a_lost_file_is_named(folder):
    (folder / "step_30" / "state.pt").unlink()
    with pytest.warns(UserWarning, match="state.pt cannot be read"):
        assert checkpoint.load(folder).step == 20


@pytest.mark.parametrize("file", ["state.pt", "config.json"])
@pytest.mark.parametrize("where", [0.0, 0.3, 0.9])
def test_a_flipped_bit_is_found(folder, file, where):
    path = folder / "step_30" / file
    data = bytearray(path.read_bytes())
    data[int(where * len(data))] ^= 16
    path.write_bytes(data)
    with pytest.warns(UserWarning, match=f"{file} does not have the sha256"):
        assert checkpoint.load(folder).step == 20


def test_the_newest_whole_one_is_used_however_many_are_damaged(folder):
    for n in (20, 30):
        os.truncate(folder / f"step_{n}" / "state.pt", 100)
    with pytest.warns(UserWarning) as caught:
        assert checkpoint.load(folder).step == 10
    assert len(caught) == 2


def test_nothing_starts_from_scratch_when_all_are_damaged(folder):
    for n in (10, 20, 30):
        os.truncate(folder / f"step_{n}" / "state.pt", 100)
    with pytest.raises(CheckpointError, match="Every checkpoint.*step_30.*step_20.*step_10"):
        checkpoint.load(folder)


def test_a_chosen_one_that_is_damaged_is_not_replaced(folder):
    os.truncate(folder / "step_30" / "state.pt", 100)
    with pytest.raises(CheckpointError, match="step_30"):
        checkpoint.load(folder / "step_30")


def test_an_empty_folder_is_told(tmp_path):
    with pytest.raises(CheckpointError, match="no checkpoint"):
        checkpoint.load(tmp_path)


class Payload:
    """Pickles into a call of open(path, 'w')."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize(
    "write", [torch.save, lambda value, file: pickle.dump(value, open(file, "wb"))]
)
def test_code_in_a_checkpoint_is_refused_and_not_run(folder, tmp_path, write):
    mark, path = tmp_path / "ran", folder / "step_30" / "state.pt"
    write({"weights": Payload(mark)}, path)
    manifest = json.loads((path.parent / "manifest.json").read_text())
    manifest["files"]["state.pt"]["sha256"] = checkpoint.hashlib.sha256(
        path.read_bytes()
    ).hexdigest()
    (path.parent / "manifest.json").write_text(json.dumps(manifest))
    with pytest.warns(UserWarning, match="step_30 is refused"):
        assert checkpoint.load(folder).step == 20
    assert not mark.exists()


def test_another_format_is_named(folder):
    path = folder / "step_30" / "manifest.json"
    path.write_text(path.read_text().replace('"format": 2', '"format": 7'))
    with pytest.raises(CheckpointError, match="format 7.*format 2.*use the megastep that wrote it"):
        checkpoint.load(folder)


def test_the_last_ones_and_the_best_stay(tmp_path):
    for n, score in ((1, 5.0), (2, 9.0), (3, None), (4, 1.0), (5, 2.0)):
        checkpoint.save(tmp_path, n, state(n), CONFIG, keep=2, score=score)
    assert names(tmp_path) == ["step_2", "step_4", "step_5"]


def test_nothing_is_deleted_before_the_new_one_is_known_to_be_whole(folder, monkeypatch):
    def write(path, data):
        path.write_bytes(data[: len(data) // 2])

    monkeypatch.setattr(checkpoint, "_write", write)
    with pytest.raises(CheckpointError, match="step_40"):
        checkpoint.save(folder, 40, state(40), CONFIG, keep=2)
    assert names(folder) == ["step_10", "step_20", "step_30", "step_40"]


def test_the_same_step_can_be_saved_again(folder):
    checkpoint.save(folder, 30, state(31), CONFIG, keep=3)
    assert checkpoint.load(folder).state["samples"] == 31


def test_a_full_disk_leaves_what_was_there(folder, monkeypatch):
    def write(path, data):
        path.write_bytes(data[:10])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(checkpoint, "_write", write)
    with pytest.raises(OSError, match="No space left"):
        checkpoint.save(folder, 40, state(40), CONFIG)
    assert sorted(path.name for path in folder.iterdir()) == ["step_10", "step_20", "step_30"]


def test_what_a_killed_process_left_is_ignored_and_swept(folder):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    left = folder / f"step_40.tmp-{gone.pid}"
    left.mkdir()
    (left / "state.pt").write_bytes(b"half")
    writing = folder / f"step_50.tmp-{os.getppid()}"  # a process that lives
    writing.mkdir()
    assert checkpoint.load(folder).step == 30
    checkpoint.save(folder, 60, state(60), CONFIG)
    assert not left.exists() and writing.exists()
