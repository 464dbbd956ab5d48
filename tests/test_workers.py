"""What worker processes have in common."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from tests.helpers.processes import is_running

ROOT = Path(__file__).parents[1]


def blocked_signals(process):
    """Returns the signals that a process never receives, as a bit mask."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    (mask,) = (line.split()[1] for line in lines if line.startswith("SigBlk"))
    return int(mask, 16)


#: Starts two workers, as recording does, in a process that has started none before, and prints
#: what each of them blocks.
POOL = """
from megastep import workers
from tests.test_workers import blocked_signals
with workers.terminal_signals_blocked():
    pool = workers.pool(2)
    masks = [pool.submit(blocked_signals, "self") for _ in range(2)]
print(*(mask.result() for mask in masks))
pool.shutdown()
"""


def test_workers_of_the_first_pool_never_receive_signals_of_the_terminal():
    """The pool starts multiprocessing's resource tracker, which unblocks SIGINT in passing."""
    masks = subprocess.check_output([sys.executable, "-c", POOL], cwd=ROOT, text=True).split()
    assert len(masks) == 2
    for mask in map(int, masks):
        assert all(mask >> number - 1 & 1 for number in (signal.SIGINT, signal.SIGHUP))


#: Prints the process of a pool's worker, and waits.
POOL_OF_ONE = """
import os, time
from megastep import workers
with workers.terminal_signals_blocked():
    print(workers.pool(1).submit(os.getpid).result(), flush=True)
time.sleep(1000)
"""


def test_worker_ends_soon_after_its_parent_is_killed():
    parent = subprocess.Popen(
        [sys.executable, "-c", POOL_OF_ONE], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    child = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    try:
        deadline = time.monotonic() + 5
        while is_running(child):
            assert time.monotonic() < deadline
            time.sleep(0.05)
    finally:
        if is_running(child):
            os.kill(child, signal.SIGKILL)
        parent.stdout.close()
