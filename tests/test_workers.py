"""Parallel processes: results in order, and an end without noise whatever ends them."""

import math
import os
import signal
import time
from pathlib import Path

import pytest

from megastep.workers import MIN_PARALLEL, parallel_map


def test_results_are_in_order():
    items = [float(n) for n in range(MIN_PARALLEL + 3)]
    assert parallel_map(math.sqrt, items, "roots") == [math.sqrt(item) for item in items]


def test_first_exception_is_raised():
    with pytest.raises(ValueError, match="math domain error|nonnegative"):
        parallel_map(math.sqrt, [1.0] * MIN_PARALLEL + [-1.0], "roots")


def blocked_signals(process):
    """Returns the signals that a process never receives, as a bit mask."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    (mask,) = (line.split()[1] for line in lines if line.startswith("SigBlk"))
    return int(mask, 16)


def is_worker(process):
    """Returns False of the trackers of resources that an earlier test may have started."""
    return b"resource_tracker" not in Path(f"/proc/{process}/cmdline").read_bytes()


def test_signal_stops_it_without_a_traceback(capfd):
    """An interrupt while others compute: nothing of loky's is printed, and no process is left."""
    children, masks = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children"), []

    def interrupt(number, frame):
        workers = [pid for pid in children.read_text().split() if is_worker(pid)]
        masks.extend(map(blocked_signals, workers))
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, 1.0)
        with pytest.raises(KeyboardInterrupt):
            parallel_map(time.sleep, [60.0] * MIN_PARALLEL, "sleeps")
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    for number in (signal.SIGINT, signal.SIGHUP):
        assert masks and all(mask >> number - 1 & 1 for mask in masks)
    assert "Traceback" not in capfd.readouterr().err
