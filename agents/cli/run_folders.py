"""Run folders: new ones, existing ones by name, and what is written in them."""

import difflib
import json
import os
import shutil
import time
from contextlib import contextmanager
from pathlib import Path

import yaml

from agents.cli.build import as_tree
from agents.cli.errors import UserError

RUNS = Path("runs")
SWEEPS = Path("sweeps")


# ---- Folders ----


def fresh(path):
    """Makes a new folder and returns it; a taken name gets -2, -3, ... UserError unless it can be
    written to.
    """
    path, number = Path(path), 2
    place = path
    while place.exists():
        place, number = path.with_name(f"{path.name}-{number}"), number + 1
    try:
        place.mkdir(parents=True)
    except OSError as error:
        raise UserError(
            f"The run folder {place} cannot be made ({error.strerror}); choose another with folder="
        ) from error
    return place


def new(cfg):
    """The folder of a new run: `cfg.folder`, which must be new or empty, or one named after time
    and settings.
    """
    if cfg.folder is None:
        return fresh(
            RUNS
            / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}-{cfg.env.name}-{cfg.geometry.name}-{cfg.seed}"
        )
    path = Path(cfg.folder)
    if path.exists() and not path.is_dir():
        raise UserError(f"The run folder {path} is a file; choose another with folder=")
    if not path.is_dir():
        return fresh(path)
    if not os.access(path, os.W_OK | os.X_OK):
        raise UserError(f"The run folder {path} cannot be written to; choose another with folder=")
    if any(path.iterdir()):
        raise UserError(
            f"The run folder {path} is not empty; choose another with folder=, or go on with "
            f"resume={path}"
        )
    return path


@contextmanager
def cleanup_on_error(folder):
    """Deletes a new folder again if setting up fails, so that nothing half-written stays behind."""
    try:
        yield
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def find(name):
    """An existing run's folder, from a path, `latest`, or one of its checkpoints. UserError that
    names the nearest run.
    """
    known = sorted(
        (p.parent for p in [*RUNS.glob("*/checkpoints"), *SWEEPS.glob("*/*/checkpoints")]),
        key=lambda p: p.stat().st_mtime,
    )
    if name == "latest":
        if not known:
            raise UserError(
                f"There is no run in {RUNS}/ or {SWEEPS}/ yet; python train.py makes one"
            )
        return known[-1]
    path = Path(name)
    if is_checkpoint(path) or (path / "checkpoints").is_dir():
        return path
    if path.exists():
        raise UserError(f"{path} is no run: it has no folder named checkpoints")
    near = difflib.get_close_matches(str(path), [str(k) for k in known], n=1, cutoff=0.4)
    raise UserError(f"There is no run {path}" + (f"; did you mean {near[0]}?" if near else ""))


def is_checkpoint(path):
    return (path / "manifest.json").exists()


def folder_of(path):
    """The run folder that a path given by `find` belongs to."""
    return path.parent.parent if is_checkpoint(path) else path


def headline(result):
    """What a finished job achieved, in a few words: the return in its table (an evaluation's file,
    or the one of a run's last checkpoint), else the last return seen in training. `result` is what
    the job returned, None if it failed.
    """
    from agents.metrics import read

    if result is None:
        return ""
    tables = [result] if result.is_file() else sorted(result.glob("evaluations/*.json"))
    try:
        tables = [json.loads(path.read_text()) for path in tables if path.suffix == ".json"]
        last = max(tables, key=lambda table: (table["step"], not table["evaluation"]["greedy"]))
        row = last["rows"][0]
        return f"{row['return']:.2f} ({row['low']:.2f} to {row['high']:.2f})"
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


def write_config(folder, cfg):
    """Writes the composed configuration, config.yaml."""
    (folder / "config.yaml").write_text(yaml.safe_dump(as_tree(cfg), sort_keys=False))
