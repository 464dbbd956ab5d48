"""The store of ranks: who can reach it, and what a stranger in it can do."""

import contextlib
import json
import os
import socket
import sys
from pathlib import Path

import pytest
from torch import distributed

from megastep.agents.launch import loopback, started, watch
from tests.helpers import tiny
from tests.helpers.processes import start, wait_until


def listening(pids):
    """Returns the addresses, in hexadecimal, at which processes listen."""
    inodes = set()
    for pid in pids:
        for handle in Path(f"/proc/{pid}/fd").iterdir():
            try:
                inodes.add(os.readlink(handle))
            except OSError:  # closed meanwhile
                continue
    addresses = set()
    for name in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and f"socket:[{fields[9]}]" in inodes:
                addresses.add(fields[1].rpartition(":")[0])
    return addresses


LOOPBACK = {"0100007F"}  # 127.0.0.1


@pytest.fixture(scope="module")
def store():
    meeting = loopback.Loopback("token")
    return distributed.TCPStore(loopback.ADDRESS, meeting.port, wait_for_workers=False), meeting


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_store_listens_on_loopback_alone(store):
    _, meeting = store
    assert listening([os.getpid()]) == LOOPBACK
    info = meeting.next_rendezvous()
    info.store.set("a", "b")
    assert info.bootstrap_store_info.master_addr == "127.0.0.1" and info.store.get("a") == b"b"
    with pytest.raises(OSError), socket.socket() as other:
        other.bind(("127.0.0.2", 0))
        other.connect(("127.0.0.2", meeting.port))


def test_only_a_folder_with_the_token_of_this_start_is_gone_on_with(store, tmp_path):
    store = distributed.PrefixStore("proof", store[0])
    run, other = tmp_path / "run", tmp_path / "other"
    assert started.proven_folder(store) is None
    for folder in (run, other):
        folder.mkdir()
        started.leave_proof(store, folder)
    started.leave_proof(store, run)
    assert started.proven_folder(store) == run
    _, token = json.loads(store.get(started.KEY))
    link = tmp_path / "link"
    link.mkdir()
    (link / started.FILE).symlink_to(run / started.FILE)
    forged = [[str(other), token], [str(tmp_path), token], [str(run), ""], [str(run), None], 3]
    forged += [[str(link), token], [str(run), "0" * 64], str(run), [None, token], ["\0", token]]
    for value in forged:
        store.set(started.KEY, json.dumps(value))
        assert started.proven_folder(store) is None, value
    store.set(started.KEY, b"\xff")
    assert started.proven_folder(store) is None
    store.set(started.KEY, json.dumps([str(run), token]))
    started.remove_proof(run)
    assert started.proven_folder(store) is None and other.is_dir()


@pytest.mark.parametrize("value", [b"", b"\xff", b"3", b"[]", b'["a", 1, 2, 3, 4, "x"]'])
def test_a_heartbeat_that_is_none_is_left_out(store, value, monkeypatch):
    for name, text in dict(RANK="0", WORLD_SIZE="2", LOCAL_RANK="0").items():
        monkeypatch.setenv(name, text)
    one = watch.Watch(lambda problem: None)
    one.store = distributed.PrefixStore("watch", store[0])
    one.store.set("heartbeat 1", value)
    assert one._heartbeat_of(1) is None
    assert one._beat() == one._heartbeat_of(0)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_ranks_of_one_machine_listen_on_loopback_alone(tmp_path):
    words = [*tiny.TINY, "ranks=2", "folder=run", "logging.every=1"]
    process = start("train", *words, cwd=tmp_path)
    try:
        wait_until(lambda: (tmp_path / "run/metrics.jsonl").exists(), process)
        tree = [process.pid, *map(int, children_of(process.pid))]
        assert len(tree) >= 3 and listening(tree) == LOOPBACK
    finally:
        process.terminate()
        process.communicate()
    assert process.returncode == 143


def children_of(pid):
    """Returns the numbers of a process's children, whichever of its threads started them."""
    children = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            children += (task / "children").read_text().split()
    return children
