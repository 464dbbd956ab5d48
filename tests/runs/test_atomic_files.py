"""Small files that many write at once."""

import multiprocessing
import os
import threading

import pytest

from megastep.atomic_files import write_atomically
from tests.helpers import faults

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


def test_an_error_leaves_the_old_content_and_nothing_else(tmp_path):
    path = tmp_path / ("ü" * 120)
    write_atomically(path, b"old")
    with faults.full_disk(10), pytest.raises(OSError):
        write_atomically(path, b"x" * 20)
    assert path.read_bytes() == b"old" and [*tmp_path.iterdir()] == [path]
