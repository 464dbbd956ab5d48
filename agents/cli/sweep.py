"""Several runs, one after the other, each in a folder of its own."""

import dataclasses
import sys
import time
from pathlib import Path

from agents.cli import run_folders
from agents.cli.console import say, table
from agents.cli.errors import UserError


def sweep(run, overrides, settings):
    """Runs the jobs one after the other, each in its own folder, past those that fail. Returns the
    exit code.
    """
    base = run_folders.fresh(Path("sweeps") / time.strftime("%Y-%m-%d_%H-%M-%S"))
    rows = []
    for number, (words, job) in enumerate(zip(overrides, settings)):
        label = ",".join(words).replace("/", "_") or "default"
        if hasattr(job, "folder"):
            job = dataclasses.replace(job, folder=str(base / f"{number}_{label[:100]}"))
        say(f"Job {number + 1} of {len(settings)}: {' '.join(words)}")
        start = time.monotonic()
        try:
            result = run(job)
            state = "done"
        except Exception as error:  # whatever it is, the other jobs are worth running
            reason = (
                str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
            )
            result, state = None, f"FAILED: {reason}"
            say(f"Job {number + 1} {state}", sys.stderr)
        rows.append(
            (
                str(number),
                " ".join(words),
                state,
                run_folders.headline(result),
                f"{time.monotonic() - start:.0f} s",
            )
        )
    say(table(("job", "overrides", "state", "return", "time"), rows, title="Sweep"))
    return 2 if any(row[2] != "done" for row in rows) else 0
