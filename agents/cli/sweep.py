"""Several runs, one after the other, each in a folder of its own."""

import dataclasses
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from agents.cli import run_folders
from agents.cli.console import say, table
from agents.cli.errors import UserError


def sweep(run: Callable[[Any], Any], overrides: list[list[str]], settings: list[Any]) -> int:
    """Runs the jobs one after the other, each in its own folder, past those that fail. Returns the
    exit code.
    """
    base = run_folders.make(Path("sweeps") / time.strftime("%Y-%m-%d_%H-%M-%S"))
    rows = []
    try:
        for number, (words, job) in enumerate(zip(overrides, settings, strict=True)):
            if hasattr(job, "folder"):
                job = dataclasses.replace(job, folder=str(base / _name(number, words)))
            say(f"Job {number + 1} of {len(settings)}: {' '.join(words)}")
            start = time.monotonic()
            state, result = _run(run, job)
            if state != "done":
                say(f"Job {number + 1} {state}", sys.stderr)
            took = f"{time.monotonic() - start:.0f} s"
            rows.append((str(number), " ".join(words), state, run_folders.headline(result), took))
    finally:  # of an interrupted sweep, the jobs that were done
        say(table(("job", "overrides", "state", "return", "time"), rows, title="Sweep"))
    return 1 if any(row[2] != "done" for row in rows) else 0


def _name(number: int, words: list[str]) -> str:
    """The name of a job's folder, of at most 255 bytes."""
    label = ",".join(words).replace("/", "_") or "default"
    return f"{number}_{label.encode()[:200].decode(errors='ignore')}"


def _run(run: Callable[[Any], Any], job: Any) -> tuple[str, Any]:
    """What became of a job, and what it returned, None if it failed."""
    try:
        return "done", run(job)
    except UserError as error:
        return f"FAILED: {error}", None
    except Exception as error:  # whatever it is, the other jobs are worth running
        return f"FAILED: {type(error).__name__}: {error}", None
