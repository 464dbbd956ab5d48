"""Run folders: new ones, existing ones by name, and their locks."""

import contextlib
import dataclasses
import difflib
import errno
import itertools
import os
import re
import shlex
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from megastep.agents import console, package
from megastep.agents.errors import UserError, shortened, user_errors
from megastep.agents.runs import (
    agent_file,
    checkpoint,
    checkpoint_format,
    formats,
    strange_files,
)

RUNS, SWEEPS = Path("runs"), Path("sweeps")
#: One line for each start of a run: its folder.
STARTED = RUNS / "started.txt"
#: Settings of earlier runs that no longer exist, and changed nothing that a run learns.
REMOVED = ("nonfinite_replay",)
#: The beginning of an error's message.
CANNOT = "{} cannot be written; choose another with folder=: "


# ---- New folders ----


def for_file(name: str) -> str:
    """Returns a name without what a file's cannot have."""
    return re.sub(r"[^\w.-]", "-", name)


def make(path: Path) -> Path:
    """Makes a new folder and returns it; a taken name gets -2, -3, ..."""
    with user_errors(CANNOT.format(shortened(path))):
        path.parent.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            folder = path if number == 1 else path.with_name(f"{path.name}-{number}")
            with contextlib.suppress(FileExistsError):  # another program may have just taken it
                folder.mkdir()
                return folder


def new(name: str, folder: str | None = None, is_again: bool = False) -> Path:
    """Returns the folder of a new run: `folder`, which must be new or empty, or by default one
    called after the time and `name`.

    Args:
        is_again: as for `check_free`.
    """
    if folder is None:
        return make(RUNS / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}-{for_file(name)}")
    check_free(folder, is_again)
    return Path(folder) if os.path.exists(folder) else make(Path(folder))


def check_free(name: str | None, is_again: bool = False) -> None:
    """Raises UserError if the folder of a new run is not empty, or cannot be read.

    Args:
        is_again: it may be that of a run which ended before it saved anything.
    """
    folder = Path(name or "")
    with user_errors(CANNOT.format(shortened(folder))):
        entries = [*folder.iterdir()] if name is not None and os.path.exists(folder) else []
    # Hydra writes .hydra/ and a log before the job of a sweep starts
    used = [path for path in entries if path.name != ".hydra" and path.suffix != ".log"]
    if is_again and used:
        strange_files.check_folder(folder)
        used = used if not {"lock", "config.yaml"} & {path.name for path in used} else []
    if used:
        raise UserError(
            f"The run folder {folder} is not empty; choose another with folder=, or continue "
            f"its run: {resume_command(folder)}"
        )


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keeps other processes from training in a run folder.

    The system holds the lock for as long as this process lives, so none is ever stale: neither
    after kill -9, nor when another process gets the number in the file.

    Raises:
        UserError: naming the process that trains there, or that the folder cannot be written.
    """
    import filelock  # which takes a while

    # its last owner may just be deleting it
    lock = filelock.FileLock(path := folder / "lock", timeout=0.2)
    try:
        lock.acquire()
        with open(path, "w", opener=strange_files.opener) as file:
            file.write(str(os.getpid()))
    except filelock.Timeout:
        with user_errors(f"The run folder {folder} is in use, or was just now: "):
            pid = path.read_text()  # its last owner may just be deleting it
        raise UserError(
            f"The run folder {folder} is in use by process {pid}; wait for it, or stop it: "
            f"kill {pid}"
        ) from None
    except OSError as error:
        with user_errors(CANNOT.format(folder)):
            if error.errno not in (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK):
                raise
        console.warn(f"{folder} is on a file system without locks; train in it only once at a time")
    try:
        yield
    finally:
        path.unlink(missing_ok=True)  # while it is locked, so that it is not another's
        lock.release()


def record_start(folder: Path) -> None:
    """Notes that training starts in a folder now. `latest` follows these notes, since folders'
    times change with whatever is written there, and clocks are moved.
    """
    with console.warned(f"{STARTED} cannot be written, so `latest` will not find {folder}: "):
        RUNS.mkdir(exist_ok=True)
        with open(STARTED, "ab") as file:
            file.write(os.fsencode(folder) + b"\n")


# ---- Existing folders ----


def known() -> list[Path]:
    """Returns the runs here, and those elsewhere that were started here; the one started or resumed
    last comes last.
    """
    lines = STARTED.read_bytes().split(b"\n") if STARTED.exists() else []
    order = {Path(os.fsdecode(line)): n for n, line in enumerate(lines) if line}
    folders = {*RUNS.glob("*"), *SWEEPS.glob("*/*"), *order}
    folders = [path for path in folders if (path / "checkpoints").is_dir()]
    return sorted(folders, key=lambda path: (order.get(path, -1), str(path)))


def pretrained() -> dict[str, Path]:
    """Returns the files of the agents that come with megastep, by name."""
    files = sorted(package.PRETRAINED.glob(f"*{agent_file.SUFFIX}"))
    return {path.stem: path for path in files}


def find(name: str) -> Path:
    """Returns an existing run's folder, one of its checkpoints, or the file of an agent.

    Args:
        name: a path, `latest`, or the name of a pretrained agent; what is at a path of that name
            comes first.

    Raises:
        UserError: naming the nearest run and the nearest pretrained agent; or what leads out of
            the run's folder, or is no file.
    """
    path, folders, agents = Path(name), known(), pretrained()
    if name == "latest" and folders:
        path = folders[-1]
    if any(os.path.exists(path / entry) for entry in ("manifest.json", "checkpoints")):
        is_in_run = path.parent.name in ("checkpoints", "snapshots")
        strange_files.check_folder(folder_of(path) if is_in_run else path)
        return path
    if agent_file.is_agent_file(path) and os.path.isfile(path):
        return path
    if os.path.exists(path):
        problem = "is no run, with a folder checkpoints"
        if name in agents:
            raise UserError(f"{name} {problem}; rename it to use the pretrained agent {name}")
    elif name in agents:
        return agents[name]
    else:
        problem = "is neither a run folder nor a pretrained agent"
    near = difflib.get_close_matches(name, map(str, folders), n=1, cutoff=0.4)
    near += difflib.get_close_matches(name, agents, n=1, cutoff=0.6)
    makes = "train.py makes runs"
    names = f"{makes}, and pretrained agents are {', '.join(agents)}" if agents else makes
    raise UserError(
        f"{shortened(name)} {problem}; " + (f"did you mean {' or '.join(near)}?" if near else names)
    )


def load_checkpoint(
    path: Path, trust: bool, device: Any = None, is_whole: bool = False, rank: int = 0
) -> checkpoint.Checkpoint:
    """Returns the checkpoint of a run or an agent found with `find`, on a device; without one, all
    but its state, and PyTorch is not imported. Warns of damaged ones it skips.

    Args:
        trust: whether a run that another user made may name modules to import.
        is_whole: loads environments and replay buffer, too, as for a run that is resumed.
        rank: whose environments and replay buffer.

    Raises:
        UserError: there is none; or, without `trust`, it names modules and another user made it.
    """
    with user_errors(kinds=(OSError, ValueError, checkpoint.CheckpointError)):
        if agent_file.is_agent_file(path):
            loaded = agent_file.read(path, device)
        else:
            loaded = checkpoint.load_latest(checkpoints_of(path), device, is_whole, rank)
    config = loaded.config
    with user_errors(f"The configuration in {loaded.path} is no run's: "):
        formats.check(formats.Config, config)
    for key in REMOVED:
        config["train"].pop(key, None)
    if loaded.untrusted and not trust:
        raise UserError(
            f"{loaded.path} was not made by this user here, and would import "
            f"{shortened(', '.join(loaded.untrusted))}, which runs code outside megastep; if you "
            "trust it, add trust=true"
        )
    return dataclasses.replace(loaded, config=checkpoint_format.with_loggers(config))


def resume_command(folder: Path, key: str = "resume") -> str:
    """Returns the command that resumes a run or, with the key `rerun`, repeats it."""
    # quoted for the shell and for Hydra where needed
    is_plain = re.fullmatch(r"[A-Za-z0-9_./:=+-]+", str(folder))
    name = str(folder) if is_plain else '"{}"'.format(str(folder).replace('"', '\\"'))
    return f"{package.command('train', 'python ')} {shlex.quote(f'{key}={name}')}"


def checkpoints_of(path: Path) -> Path:
    """A checkpoint, or the folder of a run's checkpoints."""
    return path if (path / "manifest.json").exists() else path / "checkpoints"


def folder_of(path: Path) -> Path:
    """The folder of the run that a path belongs to. The results of an agent's file, which may be
    where nobody writes, go to a folder of their own, which need not exist.
    """
    if agent_file.is_agent_file(path):
        return RUNS / f"pretrained-{path.stem}"
    return path.parent.parent if checkpoints_of(path) == path else path


def name_of(path: Path) -> str:
    """What tables call the agent at a path: the name of its run's folder, or of its file."""
    return path.stem if agent_file.is_agent_file(path) else folder_of(path).name
