"""Waits for processes, however slow the machine is."""

import time
from pathlib import Path

#: Seconds after which a process counts as hung: a hundred times what it needs.
HUNG = 1200


def wait_until(condition, process):
    """Waits until `condition()` holds. Raises AssertionError with the process's output if it ends
    or hangs before.
    """
    deadline = time.monotonic() + HUNG
    while not condition():
        if process.poll() is not None or time.monotonic() > deadline:
            process.kill()
            raise AssertionError(process.communicate())
        time.sleep(0.02)


def is_running(pid):
    """Returns whether a process exists, and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
