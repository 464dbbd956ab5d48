"""Run folders: new ones, existing ones by name, and what is written in them."""

import contextlib
import difflib
import itertools
import json
import os
import re
import shlex
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import yaml

from agents import files
from agents.cli.build import as_tree
from agents.cli.console import warn
from agents.cli.errors import UserError
from agents.cli.registry import label
from agents.cli.settings import Train

RUNS = Path("runs")
SWEEPS = Path("sweeps")
#: One line for each start of a run, its folder.
STARTED = RUNS / "started.txt"


# ---- Folders ----


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
            f"The run folder {path} cannot be made ({error.strerror}); choose another with folder="
        ) from error


def new(cfg: Train) -> Path:
    """The folder of a new run: `cfg.folder`, which must be new or empty, or one named after time
    and settings.
    """
    if cfg.folder is None:
        start = time.strftime("%Y-%m-%d_%H-%M-%S")
        return make(RUNS / f"{start}-{label(cfg.env.name)}-{label(cfg.geometry.name)}-{cfg.seed}")
    path = Path(cfg.folder)
    if not path.exists():
        return make(path)
    if not path.is_dir():
        raise UserError(f"The run folder {path} is a file; choose another with folder=")
    if not os.access(path, os.W_OK | os.X_OK):
        raise UserError(f"The run folder {path} cannot be written to; choose another with folder=")
    if any(path.iterdir()):
        raise UserError(
            f"The run folder {path} is not empty; choose another with folder=, or go on: "
            f"{resume_command(path)}"
        )
    return path


@contextlib.contextmanager
def cleanup_on_error(folder: Path) -> Iterator[None]:
    """Deletes a new folder again if setting up fails, so that nothing half-written stays behind."""
    try:
        yield
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def record_start(folder: Path) -> None:
    """Notes that training starts in a folder now: what `latest` goes by, as the times of folders
    change with whatever is written there, and clocks are moved.
    """
    try:
        RUNS.mkdir(exist_ok=True)
        with open(STARTED, "ab") as file:
            file.write(os.fsencode(folder) + b"\n")
    except OSError as error:
        warn(f"{STARTED} cannot be written ({error.strerror}); `latest` will not know {folder}")


def known() -> list[Path]:
    """The runs with checkpoints here, and elsewhere if they were started here; the one that
    started or went on last is the last.
    """
    lines = STARTED.read_bytes().split(b"\n") if STARTED.exists() else []
    order = {Path(os.fsdecode(line)): n for n, line in enumerate(lines) if line}
    found = {p.parent for p in [*RUNS.glob("*/checkpoints"), *SWEEPS.glob("*/*/checkpoints")]}
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
                f"There is no run in {RUNS}/ or {SWEEPS}/ yet; python train.py makes one"
            )
        return runs[-1]
    path = Path(name)
    if is_checkpoint(path) or (path / "checkpoints").is_dir():
        return path
    if path.exists():
        raise UserError(f"{path} is no run: it has no folder named checkpoints")
    near = difflib.get_close_matches(str(path), [str(run) for run in runs], n=1, cutoff=0.4)
    raise UserError(f"There is no run {path}" + (f"; did you mean {near[0]}?" if near else ""))


def resume_command(folder: Path) -> str:
    """What to type to go on with a run, quoted for the shell and for Hydra where that is needed."""
    if re.fullmatch(r"[A-Za-z0-9_./:-]+", str(folder)):
        return f"python train.py resume={folder}"
    name = str(folder).replace('"', '\\"')
    return "python train.py " + shlex.quote(f'resume="{name}"')


def is_checkpoint(path: Path) -> bool:
    return (path / "manifest.json").exists()


def folder_of(path: Path) -> Path:
    """The run folder that a path given by `find` belongs to."""
    return path.parent.parent if is_checkpoint(path) else path


def headline(result: Path | None) -> str:
    """What a finished job achieved, in a few words: the return in its table (an evaluation's file,
    or the one of a run's last checkpoint), or the share of duels won in it, else the last return
    seen in training. `result` is what the job returned, None if it failed.
    """
    from agents.metrics import read

    if result is None:
        return ""
    tables = [result] if result.is_file() else sorted(result.glob("evaluations/*.json"))
    try:
        tables = [json.loads(path.read_text()) for path in tables if path.suffix == ".json"]
        tables = [table for table in tables if result.is_file() or "return" in table["rows"][0]]
        last = max(tables, key=lambda table: (table["step"], not table["evaluation"]["greedy"]))
        row = last["rows"][0]
        value = f"{row['return']:.2f}" if "return" in row else f"{row['won']:.2f} won"
        return f"{value} ({row['lower']:.2f} to {row['upper']:.2f})"
    except (OSError, ValueError):
        pass
    try:
        returns = [
            row["episode/return"]
            for row in read(result / "metrics.jsonl")
            if "episode/return" in row
        ]
        return f"{returns[-1]:.2f} in training" if returns else ""
    except OSError:
        return ""


def write_config(folder: Path, cfg: Train) -> None:
    """Writes the composed configuration, config.yaml."""
    text = yaml.safe_dump(as_tree(cfg), sort_keys=False, allow_unicode=True)
    try:
        files.replace(folder / "config.yaml", text.encode())
    except OSError as error:
        raise UserError(
            f"The run folder {folder} cannot be written to ({error.strerror}); choose another with "
            "folder="
        ) from error
