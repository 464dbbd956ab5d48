"""Run folders: new ones, existing ones by name, and what is written in them."""

import contextlib
import difflib
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

import yaml
from hydra.core.hydra_config import HydraConfig

from megastep.agents.cli.build import as_tree
from megastep.agents.cli.console import warn
from megastep.agents.cli.doors import typed
from megastep.agents.cli.errors import UserError, shortened
from megastep.agents.cli.registry import label
from megastep.agents.cli.settings import Train
from megastep.agents.training.atomic_files import write_atomically

RUNS = Path("runs")
SWEEPS = Path("sweeps")
#: One line for each start of a run, its folder.
STARTED = RUNS / "started.txt"
#: Reports whose mean return is the score of a run.
REPORTS = 10


# ---- Folders ----


def from_start(path: str | Path) -> Path:
    """A path, absolute if the current folder is another (`hydra.job.chdir`) than the one that the
    program was started in, which it is relative to.
    """
    if HydraConfig.initialized() and HydraConfig.get().job.chdir:
        return Path(HydraConfig.get().runtime.cwd) / path
    return Path(path)


def brief(path: str) -> str:
    """A path relative to the folder that the program was started in, if it is below it and still
    the current one.
    """
    relative = os.path.relpath(path)
    return path if from_start("").is_absolute() or relative.startswith("..") else relative


@contextlib.contextmanager
def inside(folder: Path) -> Iterator[None]:
    """The current folder is a run's meanwhile, if hydra.job.chdir asks for it."""
    if not (HydraConfig.initialized() and HydraConfig.get().job.chdir):
        yield
        return
    before = os.getcwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def make(path: Path) -> Path:
    """Makes a new folder and returns it; a taken name gets -2, -3, ... UserError unless it can be
    written to.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            place = path if number == 1 else path.with_name(f"{path.name}-{number}")
            with contextlib.suppress(FileExistsError):  # another program may have taken it just now
                place.mkdir()
                return place
    except OSError as error:
        raise UserError(
            f"The run folder {shortened(path)} cannot be made ({error.strerror}); choose another "
            "with folder="
        ) from error


def new(cfg: Train) -> Path:
    """The folder of a new run: `cfg.folder`, which must be new or empty, or one named after time
    and settings.
    """
    if cfg.folder is None:
        start = time.strftime("%Y-%m-%d_%H-%M-%S")
        return make(
            from_start(RUNS)
            / f"{start}-{label(cfg.env.name)}-{label(cfg.geometry.name)}-{cfg.seed}"
        )
    path = from_start(cfg.folder)
    if not exists(path):
        return make(path)
    if not path.is_dir():
        raise UserError(f"The run folder {path} is a file; choose another with folder=")
    if not os.access(path, os.W_OK | os.X_OK):
        raise UserError(f"The run folder {path} cannot be written to; choose another with folder=")
    if contents(path):
        raise UserError(
            f"The run folder {path} is not empty; choose another with folder=, or go on: "
            f"{resume_command(path)}"
        )
    return path


def exists(path: Path) -> bool:
    """Whether there is a file or folder; UserError if there cannot be one of such a name."""
    try:
        return path.exists()
    except (OSError, ValueError) as error:  # too long; a NUL byte
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{shortened(path)} is no path ({reason})") from None


def contents(folder: Path) -> list[Path]:
    """What is in a folder, but for what Hydra writes there before a job starts."""
    its_own = set()
    if HydraConfig.initialized():
        hydra = HydraConfig.get()
        its_own = {hydra.output_subdir, f"{hydra.job.name}.log"}
    return [path for path in folder.iterdir() if path.name not in its_own]


@contextlib.contextmanager
def cleanup_on_error(folder: Path) -> Iterator[None]:
    """Deletes a new folder again if setting up fails, so that nothing half-written stays behind."""
    try:
        yield
    except BaseException:
        for path in contents(folder):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # Hydra's files are in it
            folder.rmdir()
        raise


def record_start(folder: Path) -> None:
    """Notes that training starts in a folder now: what `latest` goes by, as the times of folders
    change with whatever is written there, and clocks are moved.
    """
    try:
        from_start(RUNS).mkdir(exist_ok=True)
        with open(from_start(STARTED), "ab") as file:
            file.write(os.fsencode(folder) + b"\n")
    except OSError as error:
        warn(f"{STARTED} cannot be written ({error.strerror}); `latest` will not know {folder}")


def known() -> list[Path]:
    """The runs with checkpoints here, and elsewhere if they were started here; the one that
    started or went on last is the last.
    """
    runs, sweeps, started = map(from_start, (RUNS, SWEEPS, STARTED))
    lines = started.read_bytes().split(b"\n") if started.exists() else []
    order = {from_start(os.fsdecode(line)): n for n, line in enumerate(lines) if line}
    found = {p.parent for p in [*runs.glob("*/checkpoints"), *sweeps.glob("*/*/checkpoints")]}
    found |= {path for path in order if (path / "checkpoints").is_dir()}
    return sorted(found, key=lambda path: (order.get(path, -1), str(path)))


def find(name: str) -> Path:
    """An existing run's folder, from a path, `latest`, or one of its checkpoints. UserError that
    names the nearest run.
    """
    runs = known()
    if name == "latest":
        if not runs:
            raise UserError(
                f"There is no run in {RUNS}/ or {SWEEPS}/ yet; {typed('train')} makes one"
            )
        return runs[-1]
    path = from_start(name)
    if exists(path) and (is_checkpoint(path) or (path / "checkpoints").is_dir()):
        return path
    if exists(path):
        raise UserError(f"{path} is no run: it has no folder named checkpoints")
    near = difflib.get_close_matches(str(path), [str(run) for run in runs], n=1, cutoff=0.4)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise UserError(f"There is no run {shortened(path)}{hint}")


def resume_command(folder: Path) -> str:
    """What to type to go on with a run, quoted for the shell and for Hydra where that is needed."""
    if re.fullmatch(r"[A-Za-z0-9_./:=+-]+", str(folder)):
        return f"{typed('train')} resume={folder}"
    name = str(folder).replace('"', '\\"')
    return f"{typed('train')} " + shlex.quote(f'resume="{name}"')


def is_checkpoint(path: Path) -> bool:
    return (path / "manifest.json").exists()


def folder_of(path: Path) -> Path:
    """The run folder that a path given by `find` belongs to."""
    return path.parent.parent if is_checkpoint(path) else path


def outcome(result: Path | None) -> dict[str, float | None]:
    """What a job achieved. `result` is what it returned: a run folder, an evaluation's file, a
    video, or None if it failed.

    score      what a sweeper is told: a training run's mean return over its last reports, an
               evaluation's return, the share of duels won against the first opponent
    evaluated  the last of these that was measured, of sampled actions before greedy ones, with its
               interval, `lower` and `upper`; of a training run the return; absent without one
    """
    if result is None:
        return {}
    row, files = {}, [result] if result.is_file() else result.glob("evaluations/*.json")
    with contextlib.suppress(OSError, ValueError):
        tables = [json.loads(path.read_text()) for path in files if path.suffix == ".json"]
        tables = [table for table in tables if result.is_file() or "return" in table["rows"][0]]
        last = max(tables, key=lambda table: (table["step"], not table["evaluation"]["greedy"]))
        first = last["rows"][0]
        row = {"evaluated": first.get("return", first.get("won"))}
        row |= {key: first[key] for key in ("lower", "upper")}
    score = mean_return(result) if result.is_dir() else row.get("evaluated")
    return {"score": score, **row}


def mean_return(folder: Path) -> float | None:
    """The mean of the returns of a run's last `REPORTS` reports that have one."""
    from megastep.agents.training.json_lines import read

    try:
        rows = read(folder / "metrics.jsonl")
    except OSError:
        return None
    returns = [row["episode/return"] for row in rows if row.get("episode/return") is not None]
    return statistics.fmean(returns[-REPORTS:]) if returns else None


def write_config(folder: Path, cfg: Train) -> None:
    """Writes the composed configuration, config.yaml."""
    text = yaml.safe_dump(as_tree(cfg), sort_keys=False, allow_unicode=True)
    try:
        write_atomically(folder / "config.yaml", text.encode())
    except OSError as error:
        raise UserError(
            f"The run folder {folder} cannot be written to ({error.strerror}); choose another with "
            "folder="
        ) from error
