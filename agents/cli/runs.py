"""Run folders: new ones, existing ones by name, their locks, tables and scores."""

import contextlib
import difflib
import errno
import itertools
import json
import os
import re
import shlex
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from megastep.agents.cli import console, program
from megastep.agents.cli.check import as_tree
from megastep.agents.cli.program import UserError, shortened
from megastep.agents.cli.settings import (
    Env,
    Evaluate,
    Geometry,
    Train,
    env_name,
    label,
    takes_geometries,
)
from megastep.agents.distributed import environment
from megastep.agents.training import agent_file, checkpoint, json_lines
from megastep.agents.training.atomic_files import write_atomically

RUNS, SWEEPS = Path("runs"), Path("sweeps")
#: One line for each start of a run: its folder.
STARTED = RUNS / "started.txt"
INTERVAL = "95 % interval"
#: The beginning of an error's message.
CANNOT = "{} cannot be written; choose another with folder=: "


# ---- New folders ----


def for_file(name: str) -> str:
    """Returns a name without what a file's cannot have."""
    return re.sub(r"[^\w.-]", "-", name)


def make(path: Path) -> Path:
    """Makes a new folder and returns it; a taken name gets -2, -3, ..."""
    with program.errors(CANNOT.format(shortened(path))):
        path.parent.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            folder = path if number == 1 else path.with_name(f"{path.name}-{number}")
            with contextlib.suppress(FileExistsError):  # another program may have just taken it
                folder.mkdir()
                return folder


def new(cfg: Train) -> Path:
    """Returns the folder of a new run: `cfg.folder`, which must be new or empty, or one named after
    the time and the settings.
    """
    if cfg.folder is None:
        geometry = [label(cfg.geometry.name)] if takes_geometries(cfg.env) else []
        name = "-".join([env_name(cfg.env), *geometry, str(cfg.seed)])
        return make(RUNS / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}-{for_file(name)}")
    check_free(cfg.folder)
    folder = Path(cfg.folder)
    return folder if os.path.exists(folder) else make(folder)


def check_free(name: str | None) -> None:
    """Raises UserError if the folder of a new run is not empty, or cannot be read."""
    folder = Path(name or "")
    with program.errors(CANNOT.format(shortened(folder))):
        entries = [*folder.iterdir()] if name is not None and os.path.exists(folder) else []
    # Hydra writes .hydra/ and a log before the job of a sweep starts
    if [path for path in entries if path.name != ".hydra" and path.suffix != ".log"]:
        raise UserError(
            f"The run folder {folder} is not empty; choose another with folder=, or continue "
            f"its run: {resume_command(folder)}"
        )


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keeps other processes from training in a run folder.

    The system holds the lock for as long as this process lives, so none is ever stale: neither
    after kill -9, nor when another process gets the number in the file. Of several ranks, rank 0
    has the lock for all.

    Raises:
        UserError: naming the process that trains there, or that the folder cannot be written.
    """
    if environment.rank() > 0:
        yield
        return
    import filelock  # which takes a while

    # its last owner may just be deleting it
    lock = filelock.FileLock(path := folder / "lock", timeout=0.2)
    try:
        lock.acquire()
        path.write_text(str(os.getpid()))
    except filelock.Timeout:
        with program.errors(f"The run folder {folder} is in use, or was just now: "):
            pid = path.read_text()  # its last owner may just be deleting it
        raise UserError(
            f"The run folder {folder} is in use by process {pid}; wait for it, or stop it: "
            f"kill {pid}"
        ) from None
    except OSError as error:
        with program.errors(CANNOT.format(folder)):
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
    files = sorted(program.PRETRAINED.glob(f"*{agent_file.SUFFIX}"))
    return {path.stem: path for path in files}


def find(name: str) -> Path:
    """Returns an existing run's folder, one of its checkpoints, or the file of an agent.

    Args:
        name: a path, `latest`, or the name of a pretrained agent; what is at a path of that name
            comes first.

    Raises:
        UserError: naming the nearest run and the nearest pretrained agent.
    """
    path, folders, agents = Path(name), known(), pretrained()
    if name == "latest" and folders:
        return folders[-1]
    if any(os.path.exists(path / entry) for entry in ("manifest.json", "checkpoints")):
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
    with program.errors(kinds=(OSError, ValueError, checkpoint.CheckpointError)):
        if agent_file.is_agent_file(path):
            loaded = agent_file.read(path, device)
        else:
            loaded = checkpoint.load_latest(checkpoints_of(path), device, is_whole, rank)
    if loaded.untrusted and not trust:
        raise UserError(
            f"{loaded.path} was not made by this user here, and would import "
            f"{shortened(', '.join(loaded.untrusted))}, which runs code outside megastep; if you "
            "trust it, add trust=true"
        )
    return loaded


def resume_command(folder: Path) -> str:
    # quoted for the shell and for Hydra where needed
    is_plain = re.fullmatch(r"[A-Za-z0-9_./:=+-]+", str(folder))
    name = str(folder) if is_plain else '"{}"'.format(str(folder).replace('"', '\\"'))
    return f"{program.name('train', 'python ')} {shlex.quote(f'resume={name}')}"


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


# ---- Results ----


class Place(NamedTuple):
    """Where a run is evaluated.

    Attributes:
        env: the environment's name.
        source: that of the homes, or of the environment if there are none, for file names.
        choice: the choice of homes, for titles; empty if there are none.
    """

    env: str
    source: str
    choice: str

    def title(self, what: str, n_homes: int | None) -> str:
        """Returns `minimal: 1,024 episodes in 512 homes, geometry=homes, split=test`.

        Args:
            what: such as `1,024 episodes`.
            n_homes: number of homes, if known.
        """
        homes = f" in {n_homes:,} home{'s' * (n_homes > 1)}" if n_homes else ""
        return f"{self.env}: {what}{homes}{self.choice}"


def place(env: Env, geometry: Geometry, homes: list, split: str) -> Place:
    if not homes:
        return Place(env_name(env), env_name(env), "")
    path = Path(getattr(geometry, "path", None) or "")
    is_ours = geometry.name.startswith("megastep.")
    name = label(geometry.name) if is_ours else geometry.name
    choice = f", geometry={name}{f' ({path.name})' * bool(path.name)}, split={split}"
    return Place(env_name(env), "-".join(filter(None, [label(geometry.name), path.stem])), choice)


def write_table(
    cfg: Evaluate,
    loaded: checkpoint.Checkpoint,
    names: list[str],
    title: str,
    rows: list,
    cells: list[dict],
) -> Path:
    """Prints a table, and writes it into the run's folder `evaluations`: `cells` for people, .md,
    and `rows` for programs, .json. Returns the latter's path.
    """
    names = [name for name in (*names, "greedy" * cfg.greedy) if name]
    folder, name = folder_of(loaded.path) / "evaluations", for_file("-".join(names))
    head, lines = [*cells[0]], [[*row.values()] for row in cells]
    result = dict(
        title=title,
        checkpoint=str(loaded.path),
        step=loaded.step,
        evaluation=as_tree(cfg),
        rows=rows,
    )
    console.say(f"{title}\n{console.table(head, lines)}")
    with program.errors(f"{folder} cannot be written: "):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(
            folder / f"{name[:200]}.md",
            f"{title}\n\n{console.table(head, lines, is_markdown=True)}\n".encode(),
        )
        write_atomically(folder / f"{name[:200]}.json", json.dumps(result, indent=2).encode())
    return folder / f"{name[:200]}.json"


def mean_return(rows: list[dict[str, Any]], n_reports: int = 10) -> float | None:
    """Returns the score of a training run from its metrics, None if no episode finished.

    It is the mean return of the episodes that ended in the last reports, or of some more if they
    are fewer than a report's means are over (`training.episode_stats`). Each counts once, so a
    report of one lucky episode has the weight of one.
    """
    total, n_episodes, end = 0.0, 0, len(rows)
    while end > max(0, len(rows) - n_reports):
        n_in_mean = rows[end - 1].get("episode/window", 0)
        if n_in_mean:
            total += n_in_mean * rows[end - 1]["episode/return"]
            n_episodes += n_in_mean
        end, n_before = end - 1, n_in_mean - rows[end - 1].get("episode/count", 0)
        while end > 0 and n_before > 0:  # these reports are in that mean already
            end, n_before = end - 1, n_before - rows[end - 1].get("episode/count", 0)
    return total / n_episodes if n_episodes else None


def outcome(result: Path) -> dict[str, float | None]:
    """Returns what a job achieved, from what it returned.

    score: for a sweeper: a training run's `mean_return`, an evaluation's return, the share of duels
        won against the first opponent.
    evaluated, lower, upper: the evaluated one of these with its interval; of a run its return.
    """
    files, rows = [result], []
    if is_run := result.is_dir():
        files = sorted(result.glob("evaluations/*.json"))
        with contextlib.suppress(OSError):
            rows = json_lines.read(result / "metrics.jsonl")
    tables = [json.loads(file.read_text())["rows"][0] for file in files if file.suffix == ".json"]
    row = next((row for row in tables if not is_run or "return" in row), {})
    evaluated = row.get("return", row.get("won"))
    score = mean_return(rows) if is_run else evaluated
    return dict(score=score, evaluated=evaluated, lower=row.get("lower"), upper=row.get("upper"))
