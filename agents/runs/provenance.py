"""What made a run: the code, the machine and the command, a line for each time that it started."""

import contextlib
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

from megastep.agents.runs.json_lines import JsonLines

FILE = "provenance.jsonl"
GIT_TIMEOUT = 5  # seconds, as for a repository on a slow disk


def record(
    folder: Path,
    samples: int,
    device: torch.device,
    version: str,
    source: Path,
    hosts: Sequence[str] = (),
) -> None:
    """Appends a line to `provenance.jsonl` in a run folder. What cannot be found out is left out.

    Never raises: what a run learns is worth more than this.

    Args:
        samples: environment steps so far, of a run that is resumed.
        version: of megastep.
        source: the folder that megastep is in, which may be a git checkout.
        hosts: the machine of each rank, if there are several.
    """
    with contextlib.suppress(Exception), contextlib.closing(JsonLines(folder / FILE)) as lines:
        facts = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "command": shlex.join(sys.orig_argv),
            "commit": commit(source),
            "megastep": version,
            "torch": torch.__version__,
            "cuda": torch.version.cuda,
            "python": platform.python_version(),
            "device": device_name(device),
            "ranks": len(hosts) if len(hosts) > 1 else None,
            "hosts": ", ".join(dict.fromkeys(hosts)) if len(hosts) > 1 else None,
        }
        lines.write(samples, {name: text for name, text in facts.items() if text})


def made_with(device: torch.device, version: str, n_ranks: int = 1) -> dict[str, str | int]:
    """Returns what a run's numbers depend on besides its configuration and its code: where these
    are equal, equal seeds give equal bits.

    Args:
        version: of megastep.
    """
    facts = {"torch": torch.__version__, "megastep": version}
    if n_ranks > 1:
        facts["ranks"] = n_ranks
    if device.type == "cuda":
        name = torch.cuda.get_device_name(device)
        return facts | {"device": f"cuda {name}", "cuda": torch.version.cuda}
    instructions, n_threads = torch.backends.cpu.get_cpu_capability(), torch.get_num_threads()
    return facts | dict(device=device_name(device), instructions=instructions, threads=n_threads)


def commit(folder: Path) -> str | None:
    """Returns the commit of the git checkout at a folder, followed by `-dirty` if files under
    version control have changed; None if there is no checkout or no git.
    """

    def git(*words) -> str:
        command = ["git", "-C", str(folder), *words]
        # not the repository of a git hook that starts this; no lock, as somebody may work there
        env = {name: text for name, text in os.environ.items() if not name.startswith("GIT_")}
        env["GIT_OPTIONAL_LOCKS"] = "0"
        options: dict = dict(stdin=subprocess.DEVNULL, timeout=GIT_TIMEOUT, env=env)
        result = subprocess.run(command, capture_output=True, check=True, text=True, **options)
        return result.stdout.strip()

    try:
        # installed into an environment inside another project, megastep has not its commit
        if Path(git("rev-parse", "--show-toplevel")).resolve() != folder.resolve():
            return None
        return git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
    except (OSError, ValueError, subprocess.SubprocessError):
        return None


def device_name(device: torch.device) -> str:
    """Returns a GPU's name, or `cpu` and the processor's as far as the system tells it."""
    if device.type == "cuda":
        return f"{device} {torch.cuda.get_device_name(device)}"
    model = None
    with contextlib.suppress(OSError):
        model = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    return f"cpu {model[1] if model else platform.processor() or platform.machine()}"
