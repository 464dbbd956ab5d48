"""Starts scripts and threads, and waits for them, however slow the machine is."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

#: Seconds after which a process counts as hung: a hundred times what it needs.
HUNG = 1200


ROOT = Path(__file__).parents[2]


def start(script, *words, cwd=None, **environment):
    """Starts a script with pipes for stdout and stderr, in a session of its own."""
    return subprocess.Popen(
        [sys.executable, str(ROOT / f"{script}.py"), *words],
        cwd=cwd,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, **environment},
        start_new_session=True,
        # where the tests themselves run under nohup
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    )


def finished(script, *words, cwd=None, **environment):
    """Runs a script. Returns (exit code, stdout, stderr)."""
    process = start(script, *words, cwd=cwd, **environment)
    out, err = process.communicate(timeout=HUNG)
    return process.returncode, out, err


def in_threads(function, n=8):
    """Calls a function in n threads at once."""
    barrier = threading.Barrier(n)
    threads = [threading.Thread(target=lambda: (barrier.wait(), function())) for _ in range(n)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


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
