"""The store of ranks: who can reach it, and what a stranger in it can do."""

import json
import os
import sys
from pathlib import Path

import pytest
from torch import distributed

from megastep.agents.launch import endings
from tests.helpers import tiny
from tests.helpers.hosts import children
from tests.helpers.processes import start, wait_until


def test_only_a_folder_with_the_token_of_this_start_is_gone_on_with(tmp_path):
    store, token = distributed.HashStore(), "0123456789abcdef" * 4
    run, other = tmp_path / "run", tmp_path / "other"
    for folder, text in ((run, token), (other, token[::-1])):
        folder.mkdir()
        (folder / endings.STARTED).write_text(text)
    assert endings.proven_folder(store) is None
    forged = [[str(other), token], [str(tmp_path), token], [str(run), ""], [str(run), None], 3]
    forged += [[str(run), "0" * 64], str(run), [None, token], ["\0", token]]
    for value in [*map(json.dumps, forged), b"\xff"]:
        store.set(endings.KEY, value)
        assert endings.proven_folder(store) is None, value
    store.set(endings.KEY, json.dumps([str(run), token]))
    assert endings.proven_folder(store) == run


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


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_ranks_of_one_machine_listen_on_loopback_alone(tmp_path):
    words = [*tiny.TINY, "ranks=2", "folder=run", "logging.every=1"]
    process = start("train", *words, cwd=tmp_path)
    try:
        wait_until(lambda: (tmp_path / "run/metrics.jsonl").exists(), process)
        tree = [process.pid, *children(process.pid)]
        assert len(tree) >= 3 and listening(tree) == {"0100007F"}  # 127.0.0.1
    finally:
        process.terminate()
        process.communicate()
    assert process.returncode == 143
