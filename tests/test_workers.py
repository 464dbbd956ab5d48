"""What worker processes have in common."""

import signal
import subprocess
import sys
from pathlib import Path

from megastep.workers import terminal_signals_blocked


def blocked_signals(process):
    """Returns the signals that a process never receives, as a bit mask."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    (mask,) = (line.split()[1] for line in lines if line.startswith("SigBlk"))
    return int(mask, 16)


def test_processes_started_inside_never_receive_signals_of_the_terminal():
    before = blocked_signals("self")
    with terminal_signals_blocked():
        child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        mask = blocked_signals(child.pid)
        assert all(mask >> number - 1 & 1 for number in (signal.SIGINT, signal.SIGHUP))
        assert blocked_signals("self") == before
    finally:
        child.communicate(b"\n")
