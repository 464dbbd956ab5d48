"""Provenance of a run: code version, machine and command, one line per start."""

import contextlib
import json
import os
import platform
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from megastep.agents import package

FILE = "provenance.jsonl"


def record(folder: Path, samples: int, device: torch.device, hosts: Sequence[str] = ()) -> None:
    """Appends a line to a run's `provenance.jsonl`. Never raises; unknown facts are omitted."""
    with contextlib.suppress(Exception), open(folder / FILE, "a") as file:
        facts = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "command": shlex.join(sys.orig_argv),
            "commit": commit(package.ROOT),
            "python": platform.python_version(),
            **made_with(device, len(hosts)),
            "hosts": ", ".join(dict.fromkeys(hosts)) if len(hosts) > 1 else None,
        }
        known = {name: text for name, text in facts.items() if text}
        file.write(json.dumps({"samples": samples, **known}) + "\n")


def made_with(device: torch.device, n_ranks: int = 1) -> dict[str, str | int]:
    """Returns versions, device, threads and ranks, all that bits depend on beside the settings."""
    facts = {"torch": torch.__version__, "megastep": package.version()}
    if n_ranks > 1:
        facts["ranks"] = n_ranks
    if device.type == "cuda":
        name = torch.cuda.get_device_name(device)
        return facts | {"device": f"cuda {name}", "cuda": torch.version.cuda}
    model = None
    with contextlib.suppress(OSError):
        model = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    name = model[1] if model else platform.processor() or platform.machine()
    instructions, n_threads = torch.backends.cpu.get_cpu_capability(), torch.get_num_threads()
    return facts | dict(device=f"cpu {name}", instructions=instructions, threads=n_threads)


def commit(folder: Path) -> str | None:
    """Returns the commit of a git checkout, `-dirty` if tracked files have changed, or None."""
    if not (folder / ".git").exists():  # megastep may be installed inside another's checkout
        return None
    # ignore a git hook's variables, if one starts this; take no lock in the user's checkout
    env = {name: text for name, text in os.environ.items() if not name.startswith("GIT_")}
    words = "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        return subprocess.check_output(
            ["git", "-C", str(folder), *words],
            env={**env, "GIT_OPTIONAL_LOCKS": "0"},
            stdin=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=5,  # seconds; a repository may be on a slow disk
            text=True,
        ).strip()
