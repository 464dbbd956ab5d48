"""Run folders: creating, finding and locking them."""

import contextlib
import difflib
import errno
import itertools
import os
import re
import shlex
import time
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from megastep.agents import package
from megastep.agents.errors import UserError, shortened, user_errors
from megastep.agents.runs import agent_file, checkpoint, trust, typed_json
from megastep.atomic_files import write_atomically

if TYPE_CHECKING:
    import torch

RUNS, SWEEPS = Path("runs"), Path("sweeps")
#: File with the run folder of each start, one per line.
STARTED = RUNS / "started.txt"
#: The run folder of a population's first member, `populations.folder_of(root, 0)`.
MEMBER = "member-0"
#: Prefixes of error messages.
CANNOT = "{} cannot be written; choose another with folder=: "
RESUMES_NOT = "{} cannot be written, so its run cannot go on; resume a copy of the folder: "


# ---- New folders ----


def for_file(name: str) -> str:
    """Returns a name with characters that file names cannot have replaced by `-`."""
    return re.sub(r"[^\w.-]", "-", name)


def make(path: Path) -> Path:
    """Creates a folder and returns it; if it exists, `path`-2, -3, ..."""
    with user_errors(CANNOT.format(shortened(path))):
        path.parent.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            folder = path if number == 1 else path.with_name(f"{path.name}-{number}")
            with contextlib.suppress(FileExistsError):  # taken, perhaps by another process
                folder.mkdir()
                return folder
    raise AssertionError("counting never ends")


def new(name: str, folder: str | None = None, is_again: bool = False) -> Path:
    """Returns the folder of a new run, `folder` or one in `RUNS`. Raises as `check_free`."""
    if folder is None:
        return make(RUNS / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}-{for_file(name)}")
    check_free(folder, is_again)
    with user_errors(CANNOT.format(shortened(folder))):
        Path(folder).mkdir(parents=True, exist_ok=True)
    return Path(folder)


def check_free(name: str | None, is_again: bool = False) -> None:
    """UserError if a new run's folder is used; `is_again`: by no run that has saved nothing."""
    folder = Path(name or "")
    with user_errors(CANNOT.format(shortened(folder))):
        entries = [*folder.iterdir()] if name is not None and os.path.exists(folder) else []
    # Hydra writes .hydra/ and a log before the job of a sweep starts
    used = {path.name for path in entries if path.name != ".hydra" and path.suffix != ".log"}
    if used and not (is_again and {"lock", "config.yaml"} & used):
        text = f"The run folder {folder} is not empty; choose another with folder="
        if checkpoint.list_checkpoints(folder / "checkpoints"):
            text = f"{text}, or continue its run: {resume_command(folder)}"
        raise UserError(text)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Locks a run folder until kill -9 at the latest. UserError if another process has done so."""
    import filelock  # slow to import

    # the timeout is for a previous owner that is just deleting the file
    lock = filelock.FileLock(path := folder / "lock", timeout=0.2)
    try:
        lock.acquire()
        path.write_text(str(os.getpid()))
    except filelock.Timeout:
        with user_errors(f"The run folder {folder} is in use, or was just now: "):
            pid = path.read_text()  # fails if the previous owner has just deleted it
        raise UserError(
            f"The run folder {folder} is in use by process {pid}; wait for it, or stop it: "
            f"kill {pid}"
        ) from None
    except OSError as error:
        is_begun = is_population(folder) or (folder / "checkpoints").exists()
        with user_errors((RESUMES_NOT if is_begun else CANNOT).format(folder)):
            if error.errno not in (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK):
                raise
        text = f"{folder} is on a file system without locks; train in it only once at a time"
        warnings.warn(text, stacklevel=2)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)  # still locked, so it cannot be another process's
        lock.release()


def record_start(folder: Path) -> None:
    """Records that training starts in a folder, which is `latest` from then on."""
    try:
        RUNS.mkdir(exist_ok=True)
        with open(STARTED, "ab") as file:
            file.write(os.fsencode(folder) + b"\n")
    except OSError as error:
        text = f"{STARTED} cannot be written, so `latest` will not find {folder}: {error}"
        warnings.warn(text, stacklevel=2)


def write(files: Mapping[Path, str | bytes]) -> None:
    """Writes files whole, into folders that are made if need be. UserError if one cannot be."""
    for path, content in files.items():
        with user_errors(f"{path} cannot be written: "):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, content if isinstance(content, bytes) else content.encode())


# ---- Existing folders ----


def is_population(path: Path) -> bool:
    """Returns whether a folder is that of a population."""
    return (path / MEMBER).is_dir()


def known() -> list[Path]:
    """Returns the folders of all runs here or started from here, by their last start."""
    lines = STARTED.read_bytes().split(b"\n") if STARTED.exists() else []
    order = {Path(os.fsdecode(line)): n for n, line in enumerate(lines) if line}
    folders = {*RUNS.glob("*"), *SWEEPS.glob("*/*"), *order}
    folders = [p for p in folders if (p / "checkpoints").is_dir() or is_population(p)]
    return sorted(folders, key=lambda path: (order.get(path, -1), str(path)))


def pretrained() -> dict[str, Path]:
    """Returns the agent files that come with megastep, by name."""
    return {path.stem: path for path in sorted(package.PRETRAINED.glob("*.safetensors"))}


def find(name: str, member: int | str | None = "best") -> Path:
    """Returns the path of a run, a checkpoint or an agent file: an existing path, `latest`, or the
    name of a pretrained agent; of a population a member's, or its own with None. UserError.
    """
    if not name:
        raise UserError("a run has no name here; give its folder, or latest")
    path = Path(name)
    if name == "latest" and (folders := known()):
        path = folders[-1]
    if is_population(path):
        from megastep.agents.runs import populations  # slow to import

        return path if member is None else populations.member(path, member)
    is_run = any(os.path.exists(path / entry) for entry in ("manifest.json", "checkpoints"))
    if is_run or (path.suffix == agent_file.SUFFIX and os.path.isfile(path)):
        return path
    problem, agents = "is neither a run folder nor a pretrained agent", pretrained()
    if os.path.exists(path):
        problem = "is not a run: it has no folder checkpoints"
        if name in agents:
            raise UserError(f"{name} {problem}; rename it to use the pretrained agent {name}")
        if (path / "config.yaml").exists():
            raise UserError(f"{name} has no checkpoint yet; wait for one, or start its run again")
    elif name in agents:
        return agents[name]
    near = difflib.get_close_matches(name, map(str, known()), n=1, cutoff=0.4)
    near += difflib.get_close_matches(name, agents, n=1, cutoff=0.6)
    cure = f"train.py makes runs, and pretrained agents are {', '.join(agents)}"
    cure = f"did you mean {' or '.join(near)}?" if near else cure
    raise UserError(f"{shortened(name)} {problem}; {cure}")


def load_checkpoint(
    path: Path,
    is_trusted: bool,
    device: "torch.device | str | None" = None,
    is_whole: bool = False,
    rank: int = 0,
) -> checkpoint.Checkpoint:
    """Loads the latest intact checkpoint, or agent file, of a path from `find`, if trusted."""
    with user_errors(kinds=(OSError, checkpoint.CheckpointError)):
        if path.suffix == agent_file.SUFFIX:
            loaded = agent_file.read(path, device)
        else:
            loaded = checkpoint.load_latest(checkpoints_of(path), device, is_whole, rank)
    with user_errors(f"The configuration in {loaded.path} is not a run's: "):
        typed_json.check(typed_json.Config, loaded.config)
    if not is_trusted:
        trust.check(loaded.config, loaded.path)
    return loaded


def resume_command(folder: Path) -> str:
    """Returns the command that resumes a run."""
    return command_of("train", "resume", folder)


def command_of(script: str, key: str, folder: Path) -> str:
    """Returns the command that does something with a run, quoted for the shell and for Hydra."""
    return f"{package.command(script, 'python ')} {quoted(key, folder)}"


def quoted(key: str, path: Path) -> str:
    """Returns a setting that is a path, quoted for the shell and for Hydra."""
    is_plain = re.fullmatch(r"[A-Za-z0-9_./:=+-]+", str(path))
    name = str(path) if is_plain else '"{}"'.format(str(path).replace('"', '\\"'))
    return shlex.quote(f"{key}={name}")


def to_continue(folder: Path | None) -> str:
    """Returns a sentence with the command that continues a run, or why it cannot be continued."""
    from megastep.agents.runs import populations

    runs = [] if folder is None else populations.members(folder) or [folder]
    if folder is None or not all(checkpoint.list_checkpoints(run / "checkpoints") for run in runs):
        return "Nothing was saved yet"
    return f"To continue: {resume_command(folder)}"


def checkpoints_of(path: Path) -> Path:
    """Returns the `checkpoints` folder of a run; the path of a checkpoint as it is."""
    return path / "checkpoints" if (path / "checkpoints").exists() else path


def folder_of(path: Path) -> Path:
    """Returns the run folder of a path from `find`; for an agent file one for its results."""
    if path.suffix == agent_file.SUFFIX:
        return RUNS / f"pretrained-{path.stem}"
    if is_population(path):
        return path
    return path.parent.parent if checkpoints_of(path) == path else path


def name_of(path: Path) -> str:
    """Returns the agent's name in tables: that of its run folder or agent file."""
    if path.suffix == agent_file.SUFFIX:
        return path.stem
    folder = folder_of(path)
    is_member = is_population(folder.parent)
    return f"{folder.parent.name}/{folder.name}" if is_member else folder.name
