"""Run folders: new ones, existing ones by name, their locks, tables and scores."""

import contextlib
import dataclasses
import difflib
import errno
import itertools
import json
import os
import re
import shlex
import shutil
import statistics
import time
from collections.abc import Iterator
from pathlib import Path

import filelock
import yaml

from megastep.agents.cli import console, program
from megastep.agents.cli.check import as_tree
from megastep.agents.cli.program import UserError, shortened
from megastep.agents.cli.settings import Env, Evaluate, Geometry, Train, label
from megastep.agents.training import atomic_files, loggers
from megastep.agents.training.checkpoint import Checkpoint

RUNS, SWEEPS = Path("runs"), Path("sweeps")
#: One line for each start of a run: its folder.
STARTED = RUNS / "started.txt"
#: Number of reports whose mean return is the score of a run.
REPORTS = 10
#: Seconds to try for the lock of a folder: its last owner may be deleting it.
LOCK_TIMEOUT = 0.2
#: What file systems without locks answer.
NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK)
INTERVAL = "95 % interval"


@contextlib.contextmanager
def writing(path: Path, cure: str = "choose another with folder=") -> Iterator[None]:
    """Turns an OSError into a UserError that names what cannot be written, and the cure."""
    try:
        yield
    except (OSError, ValueError) as error:  # ValueError: a NUL byte
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{shortened(path)} cannot be written ({reason}); {cure}") from error


# ---- New folders ----


def make(path: Path) -> Path:
    """Makes a new folder and returns it; a taken name gets -2, -3, ..."""
    with writing(path):
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
        names = label(cfg.env.name), label(cfg.geometry.name), str(cfg.seed)
        return make(RUNS / "-".join([time.strftime("%Y-%m-%d_%H-%M-%S"), *names]))
    folder = Path(cfg.folder)
    with writing(folder):
        if not os.path.exists(folder):
            return make(folder)
        if contents(folder):
            raise UserError(
                f"The run folder {folder} is not empty; choose another with folder=, "
                f"or continue its run: {resume_command(folder)}"
            )
    return folder


def contents(folder: Path) -> list[Path]:
    """Returns what is in a folder, except what Hydra writes there before a job starts."""
    return [path for path in folder.iterdir() if path.name != ".hydra" and path.suffix != ".log"]


@contextlib.contextmanager
def cleanup_on_error(folder: Path) -> Iterator[None]:
    """Deletes a new folder again if setting up fails."""
    try:
        yield
    except BaseException:
        for path in contents(folder):
            shutil.rmtree(path, ignore_errors=True)
            path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # Hydra's files are in it
            folder.rmdir()
        raise


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keeps other processes from training in a run folder.

    The system holds the lock for as long as this process lives, so none is ever stale: neither
    after kill -9, nor when another process gets the number in the file.

    Raises:
        UserError: naming the process that trains there, or that the folder cannot be written.
    """
    lock = filelock.FileLock(path := folder / "lock", timeout=LOCK_TIMEOUT)
    try:
        lock.acquire()
        path.write_text(str(os.getpid()))
    except filelock.Timeout:
        owner = path.read_text()
        cure = f"wait for process {owner}, or end it: kill {owner}"
        raise UserError(f"The run folder {folder} is in use by process {owner}; {cure}") from None
    except OSError as error:
        with writing(folder):
            if error.errno not in NO_LOCKS:
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
    try:
        RUNS.mkdir(exist_ok=True)
        with open(STARTED, "ab") as file:
            file.write(os.fsencode(folder) + b"\n")
    except OSError as error:
        reason = f"cannot be written ({error.strerror})"
        console.warn(f"{STARTED} {reason}; `latest` will not find {folder}")


def write_config(folder: Path, cfg: Train) -> None:
    """Writes the composed configuration, config.yaml."""
    text = yaml.safe_dump(as_tree(cfg), sort_keys=False, allow_unicode=True)
    with writing(folder):
        atomic_files.replace(folder / "config.yaml", text.encode())


# ---- Existing folders ----


def known() -> list[Path]:
    """Returns the runs here, and those elsewhere that were started here; the one started or resumed
    last comes last.
    """
    lines = STARTED.read_bytes().split(b"\n") if STARTED.exists() else []
    order = {Path(os.fsdecode(line)): n for n, line in enumerate(lines) if line}
    here = {path for path in [*RUNS.glob("*"), *SWEEPS.glob("*/*"), *order]}
    folders = [path for path in here if (path / "checkpoints").is_dir()]
    return sorted(folders, key=lambda path: (order.get(path, -1), str(path)))


def find(name: str) -> Path:
    """Returns an existing run's folder, or one of its checkpoints, from a path or `latest`.

    Raises:
        UserError: naming the nearest run.
    """
    path, folders = Path(name), known()
    if name == "latest":
        if folders:
            return folders[-1]
        cure = f"{program.name('train', 'python ')} makes one"
        raise UserError(f"There is no run in {RUNS}/ or {SWEEPS}/; {cure}")
    if any(os.path.exists(path / entry) for entry in ("manifest.json", "checkpoints")):
        return path
    if os.path.exists(path):
        raise UserError(f"{path} is no run: it has no folder named checkpoints")
    near = difflib.get_close_matches(name, map(str, folders), n=1, cutoff=0.4)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise UserError(f"There is no run {shortened(path)}{hint}")


def resume_command(folder: Path) -> str:
    """Returns what to type to continue a run, quoted for the shell and for Hydra where needed."""
    word = f"resume={folder}"
    if not re.fullmatch(r"[A-Za-z0-9_./:=+-]+", word):
        word = shlex.quote('resume="{}"'.format(str(folder).replace('"', '\\"')))
    return f"{program.name('train', 'python ')} {word}"


def checkpoints_of(path: Path) -> Path:
    """Returns where to load from a path that `find` returned: a checkpoint, or a folder of them."""
    return path if (path / "manifest.json").exists() else path / "checkpoints"


def folder_of(path: Path) -> Path:
    """Returns the run folder of a path that `find` returned, or of a checkpoint."""
    return path.parent.parent if checkpoints_of(path) == path else path


# ---- Results ----


def place(env: Env, geometry: Geometry, homes: list, split: str) -> tuple[str, str]:
    """Returns where a run is evaluated, for titles, and the source of homes, for file names."""
    if not homes:
        return label(env.name), label(env.name)
    path = getattr(geometry, "path", None)
    source = label(geometry.name) + (f"-{Path(path).stem}" if path else "")
    which = "all" if split == "all" else f"the {split}"
    return f"{label(env.name)} in {which} homes of {source}", source


def write_table(
    cfg: Evaluate, loaded: Checkpoint, names: list[str], title: str, rows: list, cells: list[dict]
) -> Path:
    """Prints a table, and writes it into the run's folder `evaluations`: `cells` for people, .md,
    and `rows` for programs, .json. Returns the latter's path.
    """
    names = [name for name in (*names, "greedy" if cfg.greedy else "") if name]
    path = folder_of(loaded.path) / "evaluations" / re.sub(r"[^\w.-]", "-", "-".join(names))[:200]
    head, lines = [*cells[0]], [[*row.values()] for row in cells]
    result = dict(title=title, checkpoint=str(loaded.path), step=loaded.step, rows=rows)
    text = json.dumps(result | {"evaluation": dataclasses.asdict(cfg)}, indent=2) + "\n"
    console.say(f"{title}\n{console.table(head, lines)}")
    with writing(path.parent, "the evaluation is only printed"):
        path.parent.mkdir(exist_ok=True)
        table = f"{title}\n\n{console.markdown(head, lines)}"
        for suffix, content in ((".md", table), (".json", text)):
            atomic_files.replace(path.parent / f"{path.name}{suffix}", content.encode())
    return path.parent / f"{path.name}.json"


def outcome(result: Path | None) -> dict[str, float | None]:
    """Returns what a job achieved; `result` is what it returned, None if it failed.

    score: for a sweeper: a training run's mean return over its last reports, an evaluation's
        return, the share of duels won against the first opponent.
    evaluated, lower, upper: the last of these that was measured, with its interval; sampled actions
        come before greedy ones. Of a training run the return.
    """
    if result is None:
        return {}
    row, is_run = {}, result.is_dir()
    with contextlib.suppress(OSError, ValueError):  # of no table, or a damaged one
        files = result.glob("evaluations/*.json") if is_run else [result]
        tables = [json.loads(path.read_text()) for path in files]
        tables = [table for table in tables if not is_run or "return" in table["rows"][0]]
        last = max(tables, key=lambda table: (table["step"], not table["evaluation"]["greedy"]))
        row = {key: last["rows"][0].get(key) for key in ("lower", "upper", "return", "won")}
        row["evaluated"] = row.pop("return") if row["won"] is None else row["won"]
        del row["won"]
    return {"score": mean_return(result) if is_run else row.get("evaluated"), **row}


def mean_return(folder: Path) -> float | None:
    """Returns the mean return of a run's last `REPORTS` reports that have one."""
    with contextlib.suppress(OSError, statistics.StatisticsError):
        rows = loggers.read(folder / "metrics.jsonl")
        returns = [row["episode/return"] for row in rows if row.get("episode/return") is not None]
        return statistics.fmean(returns[-REPORTS:])
    return None
