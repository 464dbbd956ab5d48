"""Checkpoints: whole or absent, and damage is named. The damage here is done for real, to files on
the disk and to processes that write them.
"""

import errno
import itertools
import json
import os
import pathlib
import pickle
import shutil
import subprocess
import sys

import pytest
import torch

from megastep.agents.training import checkpoint
from megastep.agents.training.checkpoint import CheckpointError
from tests.helpers import faults

CONFIG = {"env": {"name": "box"}}
ROOT = pathlib.Path(__file__).parents[2]


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
    loaded = checkpoint.load_latest(folder)
    assert loaded.step == 30 and loaded.config == CONFIG and loaded.path == folder / "step_30"
    assert torch.equal(loaded.state.pop("weights")["w"], torch.full((1000,), 30.0))
    assert loaded.state == {"samples": 30, "rate": 0.5, "none": None, "list": [1, 2]}


def test_one_checkpoint_can_be_chosen(folder):
    assert checkpoint.load_latest(folder / "step_10").step == 10


def test_steps_are_ordered_as_numbers(tmp_path):
    for n in (9, 20, 100):
        checkpoint.save(tmp_path, n, state(n), CONFIG, keep=9)
    assert names(tmp_path) == ["step_9", "step_20", "step_100"]


@pytest.mark.parametrize("fraction", [0, 0.1, 0.5, 0.99])
@pytest.mark.parametrize("file", ["state.pt", "config.json", "manifest.json"])
def test_a_truncated_file_is_named_and_the_checkpoint_before_is_used(folder, file, fraction):
    path = folder / "step_30" / file
    os.truncate(path, int(fraction * path.stat().st_size))
    with pytest.warns(UserWarning, match=f"step_30 is damaged: {file}.*using step_20"):
        assert checkpoint.load_latest(folder).step == 20


def test_a_lost_file_is_named(folder):
    (folder / "step_30" / "state.pt").unlink()
    with pytest.warns(UserWarning, match="state.pt cannot be read"):
        assert checkpoint.load_latest(folder).step == 20


@pytest.mark.parametrize(
    "file, every", [("manifest.json", 3), ("config.json", 1), ("state.pt", 29)]
)
def test_a_flipped_bit_is_found_and_the_file_is_named(folder, file, every):
    path = folder / "step_30" / file
    whole = path.read_bytes()
    for bit in range(0, 8 * len(whole), every):
        data = bytearray(whole)
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        with pytest.raises(checkpoint.Damaged, match=f"step_30 is damaged: {file}"):
            checkpoint.load_latest(folder / "step_30")
    with pytest.warns(UserWarning, match=f"step_30 is damaged: {file}.*using step_20"):
        assert checkpoint.load_latest(folder).step == 20
    path.write_bytes(whole)
    assert checkpoint.load_latest(folder).step == 30


def test_the_newest_whole_one_is_used_however_many_are_damaged(folder):
    for n in (20, 30):
        os.truncate(folder / f"step_{n}" / "state.pt", 100)
    with pytest.warns(UserWarning) as caught:
        assert checkpoint.load_latest(folder).step == 10
    assert len(caught) == 2


def test_nothing_starts_from_scratch_when_all_are_damaged(folder):
    for n in (10, 20, 30):
        os.truncate(folder / f"step_{n}" / "state.pt", 100)
    with pytest.raises(CheckpointError, match="Every checkpoint.*step_30.*step_20.*step_10"):
        checkpoint.load_latest(folder)


def test_a_chosen_one_that_is_damaged_is_not_replaced(folder):
    os.truncate(folder / "step_30" / "state.pt", 100)
    with pytest.raises(CheckpointError, match="step_30"):
        checkpoint.load_latest(folder / "step_30")


def test_an_empty_folder_is_told(tmp_path):
    with pytest.raises(CheckpointError, match="no checkpoint"):
        checkpoint.load_latest(tmp_path)


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
    digest = checkpoint.hashlib.sha256(path.read_bytes()).hexdigest()
    manifest["files"]["state.pt"]["sha256"] = digest
    seal(path.parent, manifest)
    with pytest.warns(UserWarning, match="step_30 is refused"):
        assert checkpoint.load_latest(folder).step == 20
    assert not mark.exists()


def seal(path, manifest):
    """Writes a manifest with the digest that makes it believable."""
    manifest.pop("sha256")
    (path / "manifest.json").write_bytes(checkpoint._sealed(manifest))


@pytest.mark.parametrize("version", [0, 1, 7])
def test_another_format_is_named_and_neither_read_nor_passed_over(folder, version):
    manifest = json.loads((folder / "step_30" / "manifest.json").read_text())
    seal(folder / "step_30", {**manifest, "format": version})
    with pytest.raises(
        CheckpointError,
        match=f"step_30 has format {version}.*format 4.*use the megastep that wrote it",
    ):
        checkpoint.load_latest(folder)


def test_a_checkpoint_from_before_manifests_had_a_digest_is_named_by_its_format(folder):
    path = folder / "step_30" / "manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["sha256"]
    path.write_text(json.dumps({**manifest, "format": 1}, indent=2))
    with pytest.raises(CheckpointError, match="step_30 has format 1"):
        checkpoint.load_latest(folder)


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


def test_the_same_step_can_be_saved_again_and_again(folder):
    for n in (31, 32, 33):
        checkpoint.save(folder, 30, state(n), CONFIG, keep=3)
        assert checkpoint.load_latest(folder).state["samples"] == n
        assert [checkpoint.step_of(path) for path in checkpoint.checkpoints(folder)] == [10, 20, 30]
    assert len(list(folder.iterdir())) == 3


def test_a_damaged_second_one_of_a_step_is_replaced_by_nothing_newer(folder):
    checkpoint.save(folder, 30, state(31), CONFIG, keep=3)
    os.truncate(checkpoint.checkpoints(folder)[-1] / "state.pt", 10)
    with pytest.warns(UserWarning, match="is damaged"):
        assert checkpoint.load_latest(folder).step == 20


class Killed(BaseException):
    """Stands for kill -9: from here on nothing happens to any file."""


@pytest.mark.parametrize("step", [30, 31, 15])
@pytest.mark.parametrize("n_old", [1, 3])
def test_killed_between_any_two_changes_of_files_a_whole_checkpoint_is_left(tmp_path, step, n_old):
    changes = [(os, "replace"), (os, "mkdir"), (shutil, "rmtree"), (checkpoint, "_write")]
    for n in itertools.count():
        folder = tmp_path / str(n)
        for old in (10, 20, 30)[-n_old:]:
            checkpoint.save(folder, old, state(old), CONFIG, keep=3)
        done = itertools.count()

        def until_killed(real, n=n, done=done):
            def change(*arguments, **options):
                if next(done) >= n:
                    raise Killed
                return real(*arguments, **options)

            return change

        with pytest.MonkeyPatch.context() as patch:
            for place, name in changes:
                patch.setattr(place, name, until_killed(getattr(place, name)))
            try:
                checkpoint.save(folder, step, state(99), CONFIG, keep=2)
                break
            except Killed:
                pass
        loaded = checkpoint.load_latest(folder)
        assert loaded.state["samples"] in (99, 30), n
        checkpoint.save(folder, step + 1, state(100), CONFIG, keep=2)
        assert checkpoint.load_latest(folder).state["samples"] == 100
        assert not list(folder.glob("*.tmp-*"))
    assert n >= 5 and checkpoint.load_latest(folder).state["samples"] == 99


SAVES_UNTIL_KILLED = """
import os, random, signal, sys, time
import torch
from megastep.agents.training import checkpoint

folder, kills, again = sys.argv[1], int(sys.argv[2]), sys.argv[3] == "again"
checkpoint.save(folder, 1, {"n": 1, "w": torch.zeros(50_000)}, {})
random.seed(1)
newest = 1
for kill in range(kills):
    child = os.fork()
    if not child:
        for n in range(newest + 1, 10**9):
            step = 1 if again else n
            checkpoint.save(folder, step, {"n": n, "w": torch.zeros(50_000)}, {})
    time.sleep(random.uniform(0, 0.08))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    found = checkpoint.load_latest(folder).state["n"]
    assert found >= newest, (found, newest)
    newest = found
checkpoint.save(folder, newest + 1, {"n": newest + 1}, {})
print(newest, *sorted(os.listdir(folder)))
"""


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("steps", ["again", "new"])
@pytest.mark.parametrize("kills", [10, pytest.param(60, marks=pytest.mark.slow)])
def test_kill_9_at_random_leaves_the_newest_whole_checkpoint(tmp_path, kills, steps):
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", SAVES_UNTIL_KILLED, tmp_path, str(kills), steps],
        cwd=ROOT,
        text=True,
        timeout=120,
        stdout=subprocess.PIPE,
    )
    assert done.returncode == 0
    newest, *left = done.stdout.split()
    assert int(newest) > kills // 10, "some processes lived long enough to save, on busy cores too"
    assert len(left) == 2 and not any("tmp" in name for name in left), left


# ---- Going on from an earlier checkpoint ----


def test_past_damaged_ones_the_new_checkpoint_stays_and_is_the_newest(folder):
    for n in (20, 30):
        os.truncate(folder / f"step_{n}" / "state.pt", 100)
    checkpoint.save(folder, 12, state(12), CONFIG, keep=2)
    assert checkpoint.load_latest(folder).step == 12
    checkpoint.save(folder, 14, state(14), CONFIG, keep=2)
    assert checkpoint.load_latest(folder).step == 14
    assert names(folder) == ["step_12", "step_14"]


def test_after_going_back_later_checkpoints_are_set_aside_at_once(folder):
    checkpoint.rewind(folder, 30)
    assert checkpoint.load_latest(folder).step == 30
    checkpoint.rewind(folder, 29)
    assert checkpoint.load_latest(folder).step == 20
    checkpoint.rewind(folder, 10)
    assert checkpoint.load_latest(folder).step == 10 and names(folder) == ["step_10"]
    assert checkpoint.load_latest(folder / "step_30.aside").step == 30, "none is lost by going back"


def test_what_was_set_aside_goes_once_the_run_has_come_as_far(folder):
    checkpoint.rewind(folder, 10)
    checkpoint.save(folder, 25, state(25), CONFIG, keep=3)
    left = sorted(path.name for path in folder.iterdir())
    assert left == ["step_10", "step_25", "step_30.aside"]
    checkpoint.rewind(folder, 10)
    checkpoint.save(folder, 30, state(30), CONFIG, keep=3)
    assert sorted(path.name for path in folder.iterdir()) == ["step_10", "step_30"]


def test_going_back_twice_sets_the_same_step_aside_twice(folder):
    checkpoint.rewind(folder, 20)
    checkpoint.save(folder, 30, state(31), CONFIG, keep=3)
    checkpoint.rewind(folder, 20)
    assert names(folder) == ["step_10", "step_20"]


def test_a_full_disk_leaves_what_was_there(folder, monkeypatch):
    def write(path, data):
        path.write_bytes(data[:10])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(checkpoint, "_write", write)
    with pytest.raises(OSError, match="No space left"):
        checkpoint.save(folder, 40, state(40), CONFIG)
    assert sorted(path.name for path in folder.iterdir()) == ["step_10", "step_20", "step_30"]


def test_a_file_that_may_not_grow_leaves_what_was_there_and_the_next_save_works(folder):
    big = {"w": torch.zeros(100_000)}
    with faults.full_disk(20_000), pytest.raises(OSError, match="File too large"):
        checkpoint.save(folder, 40, big, CONFIG)
    assert checkpoint.load_latest(folder).step == 30 and len(list(folder.iterdir())) == 3
    checkpoint.save(folder, 40, big, CONFIG)
    assert checkpoint.load_latest(folder).step == 40


def test_what_a_killed_process_left_is_ignored_and_swept(folder):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    left = folder / f"step_40.tmp-{gone.pid}"
    own = folder / f"step_45.tmp-{os.getpid()}"  # a process of this number, before this one
    writing = folder / f"step_50.tmp-{os.getppid()}"  # a process that lives
    for path in (left, own, writing):
        path.mkdir()
        (path / "state.pt").write_bytes(b"half")
    assert checkpoint.load_latest(folder).step == 30
    checkpoint.save(folder, 60, state(60), CONFIG)
    assert not left.exists() and not own.exists() and writing.exists()
