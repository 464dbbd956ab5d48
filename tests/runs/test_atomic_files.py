"""Small files that many write at once, and what killed writers leave."""

import multiprocessing
import os
import socket
import threading
import time

import pytest

from megastep.agents.runs import atomic_files
from megastep.agents.runs.atomic_files import delete_leftovers, temporary_path, write_atomically

FORK = multiprocessing.get_context("fork")


@pytest.mark.parametrize(
    "worker, barrier", [(threading.Thread, threading.Barrier), (FORK.Process, FORK.Barrier)]
)
def test_concurrent_writes_of_one_file_all_succeed(tmp_path, monkeypatch, worker, barrier):
    monkeypatch.setattr(os, "fsync", lambda handle: None)  # which would take most of the time
    path, contents = tmp_path / "table.json", [bytes([65 + n]) * 10_000 for n in range(8)]
    start, is_done = barrier(8), [FORK.Event() for _ in contents]

    def write(content, done):
        start.wait()
        for _ in range(50):
            write_atomically(path, content)
            assert path.read_bytes() in contents, "mixed"
        done.set()

    workers = [worker(target=write, args=pair) for pair in zip(contents, is_done)]
    for one in workers:
        one.start()
    for one in workers:
        one.join()
    assert all(done.is_set() for done in is_done) and os.listdir(tmp_path) == ["table.json"]


def test_a_written_file_leaves_nothing_open(tmp_path):
    n_open = len(os.listdir("/dev/fd"))
    for _ in range(3):
        write_atomically(tmp_path / "table.json", b"{}")
    assert len(os.listdir("/dev/fd")) == n_open


def left(tmp_path, monkeypatch, what, **faked):
    """Makes the temporary file or folder of a process that was killed."""
    with monkeypatch.context() as patch:
        for name, value in faked.items():
            module = {"getpid": os, "gethostname": socket}.get(name, atomic_files)
            is_function = module is not atomic_files
            patch.setattr(module, name, (lambda value=value: value) if is_function else value)
        path = temporary_path(tmp_path / ("ü" * 300))
    if what == "folder":
        path.mkdir()
        (path / "state.pt").write_bytes(b"half")
    else:
        path.write_bytes(b"half")
    return path


@pytest.mark.parametrize("what", ["file", "folder"])
def test_leftovers_go_with_their_process(tmp_path, monkeypatch, what):
    def kill(pid, number):
        assert number == 0, "a signal that ends nothing"
        if pid != 76:
            raise {77: ProcessLookupError, 78: PermissionError}[pid]

    monkeypatch.setattr(os, "kill", kill)  # where there is no /proc, only signals tell
    living, dead, of_another = (
        left(tmp_path, monkeypatch, what, getpid=pid) for pid in (76, 77, 78)
    )
    own = left(tmp_path, monkeypatch, what)
    earlier = left(tmp_path, monkeypatch, what, _TOKEN="12345678")
    delete_leftovers(tmp_path)
    assert living.exists() and of_another.exists() and own.exists()
    assert not dead.exists() and not earlier.exists()


def test_leftovers_of_another_machine_go_after_a_day(tmp_path, monkeypatch):
    # its process number is that of no process here
    paths = [
        left(tmp_path, monkeypatch, "folder", gethostname=f"node-{n}", getpid=2**22 + 1)
        for n in (7, 8)
    ]
    then = time.time() - atomic_files.ABANDONED - 60
    os.utime(paths[1], (then, then))
    write_atomically(tmp_path / "file", b"")
    assert [path.exists() for path in paths] == [True, False]
