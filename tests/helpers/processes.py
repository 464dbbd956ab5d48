"""Waits for processes, however slow the machine is."""

import time

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
