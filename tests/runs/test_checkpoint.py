"""Checkpoints are whole or absent, and damage is reported. Files are really damaged, and processes
really killed.
"""

import hashlib
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

from megastep.agents.cli import inspect
from megastep.agents.errors import UserError
from megastep.agents.runs import checkpoint, folders
from megastep.agents.runs.checkpoint import CheckpointError
from tests.helpers import faults
from tests.helpers.processes import HUNG

CONFIG = {"env": {"name": "box"}}
ROOT = pathlib.Path(__file__).parents[2]


def state(n):
    """A state whose tensor and numbers tell which save it is from."""
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
        checkpoint.save(tmp_path, n, state(n), CONFIG, keep_checkpoints=3)
    return tmp_path


def names(folder):
    return [path.name for path in checkpoint.list_checkpoints(folder)]


def test_load_returns_what_was_saved(folder):
    loaded = checkpoint.load_latest(folder)
    assert loaded.step == 30 and loaded.config == CONFIG and loaded.path == folder / "step_30"
    assert torch.equal(loaded.state.pop("weights")["w"], torch.full((1000,), 30.0))
    assert loaded.state == {"samples": 30, "rate": 0.5, "none": None, "list": [1, 2]}


def test_checkpoints_are_sorted_by_number(tmp_path):
    for n in (9, 20, 100):
        made_with = {"torch": "2.0", "threads": n}
        checkpoint.save(tmp_path, n, state(n), CONFIG, keep_checkpoints=9, made_with=made_with)
    assert names(tmp_path) == ["step_9", "step_20", "step_100"]
    assert checkpoint.load_latest(tmp_path).made_with == {"torch": "2.0", "threads": 100}


@pytest.mark.parametrize("fraction", [0, 0.1, 0.5, 0.99])
@pytest.mark.parametrize("file", ["state.pt", "config.json", "manifest.json"])
def test_truncated_file_is_named_and_the_previous_checkpoint_used(folder, file, fraction):
    path = folder / "step_30" / file
    os.truncate(path, int(fraction * path.stat().st_size))
    with pytest.warns(UserWarning, match=f"step_30 is damaged: {file}.*using step_20"):
        assert checkpoint.load_latest(folder).step == 20


def test_missing_file_is_named(folder):
    (folder / "step_30" / "state.pt").unlink()
    with pytest.warns(UserWarning, match="state.pt cannot be read"):
        assert checkpoint.load_latest(folder).step == 20


@pytest.mark.parametrize(
    "file, every", [("manifest.json", 7), ("config.json", 3), ("state.pt", 61)]
)
def test_every_flipped_bit_is_detected(folder, file, every):
    path = folder / "step_30" / file
    intact = path.read_bytes()
    for bit in range(0, 8 * len(intact), every):
        data = bytearray(intact)
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        with pytest.raises(checkpoint.DamagedCheckpoint, match=f"step_30 is damaged: {file}"):
            checkpoint.load_latest(folder / "step_30")
    with pytest.warns(UserWarning, match=f"step_30 is damaged: {file}.*using step_20"):
        assert checkpoint.load_latest(folder).step == 20
    path.write_bytes(intact)
    assert checkpoint.load_latest(folder).step == 30


@pytest.mark.filterwarnings("error::UserWarning")
def test_run_that_is_trained_meanwhile_replaces_its_checkpoints(folder, monkeypatch):
    real, tried = checkpoint.read, []

    def read(path, *arguments):
        tried.append(path.name)
        if len(tried) == 1:
            checkpoint.save(folder, 40, state(40), CONFIG, keep_checkpoints=2)
            for old in ("step_20", "step_30"):
                shutil.rmtree(folder / old, ignore_errors=True)
        return real(path, *arguments)

    monkeypatch.setattr(checkpoint, "read", read)
    assert checkpoint.load_latest(folder).step == 40 and tried == ["step_30", "step_40"]


def test_error_if_every_checkpoint_is_damaged(folder):
    for n in (30, 20):
        os.truncate(folder / f"step_{n}" / "state.pt", 100)
    with pytest.warns(UserWarning) as warnings:
        assert checkpoint.load_latest(folder).step == 10
    assert len(warnings) == 2
    os.truncate(folder / "step_10" / "state.pt", 100)
    with pytest.raises(CheckpointError, match="Every checkpoint.*step_30.*step_20.*step_10"):
        checkpoint.load_latest(folder)


class Payload:
    """Pickles into a call of open(path, 'w')."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize(
    "write", [torch.save, lambda value, file: file.write_bytes(pickle.dumps(value))]
)
def test_code_in_a_checkpoint_is_refused_and_does_not_run(folder, tmp_path, write):
    mark, path = tmp_path / "ran", folder / "step_30" / "state.pt"
    write({"weights": Payload(mark)}, path)
    seal_file(path)
    with pytest.warns(UserWarning, match="step_30 is damaged: state.pt is refused"):
        assert checkpoint.load_latest(folder).step == 20
    assert not mark.exists()


def seal(path, **changes):
    """Writes other values into a checkpoint's manifest, with a valid digest."""
    manifest = json.loads((path / "manifest.json").read_text()) | changes
    del manifest["sha256"]
    (path / "manifest.json").write_bytes(checkpoint.sealed(manifest))


def seal_file(path):
    """Writes the digest of a file into its checkpoint's manifest."""
    files = json.loads((path.parent / "manifest.json").read_text())["files"]
    files[path.name]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    seal(path.parent, files=files)


@pytest.mark.parametrize(
    "name", ["../../secret", "rank0.pt", "xrank1.pt", "rank1.pt.x", "/etc/hosts"]
)
def test_manifest_names_no_other_files(folder, name):
    (folder.parent / "secret").write_bytes(b"")
    entry = {"sha256": hashlib.sha256(b"").hexdigest(), "bytes": 0}
    files = json.loads((folder / "step_30/manifest.json").read_text())["files"]
    seal(folder / "step_30", files=files | {name: entry})
    with pytest.warns(UserWarning, match="manifest.json: files.*using step_20"):
        assert checkpoint.load_latest(folder).step == 20


@pytest.mark.parametrize(
    "version, cure",
    [(7, "use the commit in the provenance.jsonl"), (1, "use the commit"), (99, "update megastep")],
)
def test_other_formats_are_refused_by_name_and_not_skipped(folder, version, cure):
    seal(folder / "step_30", format=version)
    with pytest.raises(CheckpointError, match=f"step_30 has format {version}, .*; {cure}"):
        checkpoint.load_latest(folder)


def test_last_checkpoints_and_the_best_are_kept(tmp_path):
    for n, score in ((1, 5.0), (2, 9.0), (3, None), (4, 1.0), (5, 2.0)):
        checkpoint.save(tmp_path, n, state(n), CONFIG, keep_checkpoints=2, score=score)
    assert names(tmp_path) == ["step_2", "step_4", "step_5"]


def test_same_step_can_be_saved_repeatedly(folder):
    for n in (31, 32, 33):
        checkpoint.save(folder, 30, state(n), CONFIG, keep_checkpoints=3)
        assert checkpoint.load_latest(folder).state["samples"] == n
        steps = [checkpoint.step_of(path) for path in checkpoint.list_checkpoints(folder)]
        assert steps == [10, 20, 30]
    assert len(list(folder.iterdir())) == 3


class Killed(BaseException):
    """Stands for kill -9: no file changes after it."""


@pytest.mark.parametrize("step", [30, 31, 15])
@pytest.mark.parametrize("n_old", [1, 3])
def test_kill_between_any_two_file_operations_leaves_an_intact_checkpoint(tmp_path, step, n_old):
    operations = [(os, "replace"), (os, "mkdir"), (shutil, "rmtree")]
    operations += [(checkpoint, "save_tensors"), (checkpoint, "_write")]
    for n in itertools.count():
        folder = tmp_path / str(n)
        for old in (10, 20, 30)[-n_old:]:
            checkpoint.save(folder, old, state(old), CONFIG, keep_checkpoints=3)
        n_done = itertools.count()

        def until_killed(real, n=n, n_done=n_done):
            def operation(*args, **kwargs):
                if next(n_done) >= n:
                    raise Killed
                return real(*args, **kwargs)

            return operation

        with pytest.MonkeyPatch.context() as patch:
            for module, name in operations:
                patch.setattr(module, name, until_killed(getattr(module, name)))
            try:
                checkpoint.save(folder, step, state(99), CONFIG, keep_checkpoints=2)
                break
            except Killed:
                pass
        loaded = checkpoint.load_latest(folder)
        assert loaded.state["samples"] in (99, 30), n
        checkpoint.save(folder, step + 1, state(100), CONFIG, keep_checkpoints=2)
        assert checkpoint.load_latest(folder).state["samples"] == 100
        assert not list(folder.glob("*.tmp-*"))
    assert n >= 4 and checkpoint.load_latest(folder).state["samples"] == 99


def test_checkpoint_is_on_disk_before_it_is_renamed(tmp_path, monkeypatch):
    """After a power cut, the disk holds what was flushed: its files and folder, then the rename."""
    events = []

    def recorded(operation, of):
        def call(*args):
            operation(*args)
            events.append(of(*args))

        return call

    def renamed(temporary, path):
        return {entry.stat().st_ino for entry in (path, *path.iterdir())}

    monkeypatch.setattr(os, "fsync", recorded(os.fsync, lambda handle: os.fstat(handle).st_ino))
    monkeypatch.setattr(os, "replace", recorded(os.replace, renamed))
    path = checkpoint.save(tmp_path, 10, state(10), CONFIG)
    (rename,) = [at for at, event in enumerate(events) if isinstance(event, set)]
    assert events[rename] == set(events[:rename]) and len(list(path.iterdir())) == 3
    assert events[rename + 1 :] == [tmp_path.stat().st_ino]


SAVES_UNTIL_KILLED = """
import os, random, signal, sys, time
import torch
from megastep.agents.runs import checkpoint

folder, kills, again = sys.argv[1], int(sys.argv[2]), sys.argv[3] == "again"
checkpoint.save(folder, 1, {"n": 1, "w": torch.zeros(50_000)}, {})
random.seed(1)
newest = 1
for kill in range(kills):
    begun, begins = os.pipe()
    child = os.fork()
    if not child:
        for n in range(newest + 1, 10**9):
            os.write(begins, b".")
            step = 1 if again else n
            checkpoint.save(folder, step, {"n": n, "w": torch.zeros(50_000)}, {})
    os.read(begun, 1), os.read(begun, 1)  # it has saved once
    time.sleep(random.uniform(0, 0.08))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    loaded = checkpoint.load_latest(folder).state["n"]
    assert loaded > newest, (loaded, newest)
    newest = loaded
checkpoint.save(folder, newest + 1, {"n": newest + 1}, {})
print(newest, *sorted(os.listdir(folder)))
"""


@pytest.mark.filterwarnings("error::UserWarning")
@pytest.mark.parametrize(
    "kills, steps", [(5, "new"), pytest.param(40, "again", marks=pytest.mark.nightly)]
)
def test_kill_9_at_random_leaves_the_newest_checkpoint_intact(tmp_path, kills, steps):
    process = subprocess.run(
        [sys.executable, "-W", "error", "-c", SAVES_UNTIL_KILLED, tmp_path, str(kills), steps],
        cwd=ROOT,
        text=True,
        timeout=HUNG,
        stdout=subprocess.PIPE,
    )
    assert process.returncode == 0
    _, *files = process.stdout.split()
    assert len(files) == 2 and not any("tmp" in name for name in files), files


# ---- Resuming from an earlier checkpoint ----


def test_checkpoint_saved_before_damaged_later_ones_is_the_latest(folder):
    for n in (20, 30):
        os.truncate(folder / f"step_{n}" / "state.pt", 100)
    checkpoint.save(folder, 12, state(12), CONFIG, keep_checkpoints=2)
    assert checkpoint.load_latest(folder).step == 12
    checkpoint.save(folder, 14, state(14), CONFIG, keep_checkpoints=2)
    assert checkpoint.load_latest(folder).step == 14
    assert names(folder) == ["step_12", "step_14"]


def test_later_checkpoints_are_set_aside(folder):
    checkpoint.set_aside_after(folder, 30)
    assert checkpoint.load_latest(folder).step == 30
    checkpoint.set_aside_after(folder, 29)
    assert checkpoint.load_latest(folder).step == 20
    checkpoint.set_aside_after(folder, 10)
    assert checkpoint.load_latest(folder).step == 10 and names(folder) == ["step_10"]
    assert checkpoint.load_latest(folder / "step_30.aside").step == 30


def test_set_aside_checkpoint_is_deleted_when_its_step_is_reached(folder):
    checkpoint.set_aside_after(folder, 10)
    checkpoint.save(folder, 25, state(25), CONFIG, keep_checkpoints=3)
    names = sorted(path.name for path in folder.iterdir())
    assert names == ["step_10", "step_25", "step_30.aside"]
    checkpoint.set_aside_after(folder, 10)
    checkpoint.save(folder, 30, state(30), CONFIG, keep_checkpoints=3)
    assert sorted(path.name for path in folder.iterdir()) == ["step_10", "step_30"]


def test_save_works_again_after_a_full_disk(folder):
    big = {"w": torch.zeros(100_000)}
    with faults.full_disk(20_000), pytest.raises(OSError, match="the disk is full"):
        checkpoint.save(folder, 40, big, CONFIG)
    assert checkpoint.load_latest(folder).step == 30 and len(list(folder.iterdir())) == 3
    checkpoint.save(folder, 40, big, CONFIG)
    assert checkpoint.load_latest(folder).step == 40


# ---- Readers beside a writer ----


@pytest.fixture
def between_steps():
    """Returns a function that calls a reader with a writer at its n-th file operation, for each n.
    Yields what the reader returns.
    """

    def call(read, write, operations=("open", "seek", "scandir")):
        for n in itertools.count():
            n_seen = -1

            def look(frame, event, called, n=n):
                nonlocal n_seen
                if event == "c_call" and called.__name__ in operations:
                    n_seen += 1
                    if n_seen == n:
                        sys.setprofile(None)
                        write()

            sys.setprofile(look)
            try:
                result = read()
            finally:
                sys.setprofile(None)
            if n_seen < n:
                return
            yield result

    return call


@pytest.fixture
def writer(tmp_path):
    """Returns a function that saves two checkpoints and so deletes the earlier ones."""
    steps = itertools.count(1)

    def save():
        for n in itertools.islice(steps, 2):
            checkpoint.save(tmp_path / "checkpoints", n, state(n), CONFIG)

    save()
    return save


def test_reader_never_meets_a_checkpoint_that_is_being_deleted(tmp_path, writer, between_steps):
    n = 0
    for loaded in between_steps(lambda: checkpoint.load_latest(tmp_path / "checkpoints"), writer):
        assert (loaded.state["weights"]["w"] == loaded.state["samples"]).all()
        n += 1
    assert n > 5 and names(tmp_path / "checkpoints")[0] == f"step_{2 * n + 1}"


def test_inspect_of_a_run_that_is_training(tmp_path, writer, between_steps, capsys):
    results = [*between_steps(lambda: inspect.main([str(tmp_path)]), writer, ("open",))]
    text = capsys.readouterr().out
    assert len(results) > 5 and not any(results) and "damaged" not in text
    assert text.count("intact") > len(results)


def test_checkpoint_that_is_gone_keeps_its_run_folder(tmp_path, writer):
    gone = tmp_path / "checkpoints" / "step_1"
    assert folders.folder_of(gone) == tmp_path
    writer()
    assert not gone.exists() and folders.folder_of(gone) == tmp_path
    with pytest.raises(UserError, match="step_1 is gone: a run deletes .*; name the run's folder"):
        folders.load_checkpoint(gone, False)
