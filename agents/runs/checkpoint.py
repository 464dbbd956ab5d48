"""Saves, lists and loads the checkpoints of a run. Each is a folder `step_<N>`, after N steps.

A checkpoint is written to a temporary folder, flushed to disk, verified and renamed, so a reader
sees a complete checkpoint or none. Damage is detected (:mod:`checkpoint_format`). A second
checkpoint of the same step is `step_<N>-2`; the first is deleted once the second is verified.
"""

from __future__ import annotations

import os
import re
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from megastep.agents.runs import checkpoint_format
from megastep.agents.runs.atomic_files import delete_leftovers, sync_folder, temporary_path
from megastep.agents.runs.checkpoint_format import (
    Checkpoint,
    CheckpointError,
    DamagedCheckpoint,
    GoneCheckpoint,
)

if TYPE_CHECKING:
    import torch

    from megastep.agents.types import Config, Row, StateDict

_NAME = re.compile(r"step_\d+(-\d+)?")

__all__ = [
    "Checkpoint",
    "CheckpointError",
    "DamagedCheckpoint",
    "GoneCheckpoint",
    "list_checkpoints",
    "is_intact",
    "load_latest",
    "save",
    "set_aside_after",
    "step_of",
]


def save(
    folder: Path | str,
    step: int,
    state: StateDict,
    config: Config,
    keep_checkpoints: int = 2,
    score: float | None = None,
    made_with: Row | None = None,
    replay_seconds: float | None = None,
    add_files: Callable[[Path], Row] = lambda path: {},
) -> Path:
    """Writes a checkpoint and deletes old ones. Returns its folder.

    Args:
        folder: the run's `checkpoints` folder.
        step: environment steps so far, of all lanes.
        state: dicts and lists of tensors and numbers.
        config: the run's configuration, JSON.
        keep_checkpoints: number of latest steps to keep, besides the one with the highest score.
        score: such as the mean return, higher is better; None if unknown.
        made_with: versions and devices that the numbers depend on, see `provenance.made_with`.
        replay_seconds: a replay buffer that takes longer to write is left out; None: no limit.
        add_files: as for `checkpoint_format.write`.

    Raises:
        OSError: the disk is full or not writable. Other checkpoints are unchanged.
        DamagedCheckpoint: the disk does not return the bytes written. Other checkpoints are
            unchanged.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    delete_leftovers(folder)
    temporary = temporary_path(folder / f"step_{step}")
    try:
        checkpoint_format.write(
            temporary, step, state, config, score, made_with, replay_seconds, add_files
        )
        # verify it before deleting older ones
        manifest = checkpoint_format.read_manifest(temporary)
        with checkpoint_format.verified(temporary, manifest, manifest["files"]):
            pass
        path = folder / _next_name(folder, step)
        os.replace(temporary, path)
        sync_folder(folder)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    set_aside_after(folder, step)
    _prune(folder, keep_checkpoints, step)
    return path


def load_latest(
    folder: Path | str,
    device: torch.device | str | None = "cpu",
    is_whole: bool = True,
    rank: int = 0,
) -> Checkpoint:
    """Loads the newest intact checkpoint in a `checkpoints` folder, or the checkpoint at `folder`.

    Warns of each damaged checkpoint that it skips.

    Args:
        folder: a `checkpoints` folder or one checkpoint.
        device: device of weights and optimizer; the rest is loaded to the CPU. None loads no state
            and does not import PyTorch.
        is_whole: also loads environments and replay buffer.
        rank: the rank whose state is loaded, see `checkpoint_format.read`.

    Raises:
        GoneCheckpoint: its run has deleted the one at `folder`.
        CheckpointError: there is none, all are damaged, or another version of megastep wrote it.
    """
    folder, messages = Path(folder), []
    if (folder / "manifest.json").exists() or _NAME.fullmatch(folder.name):
        return checkpoint_format.read(folder, device, is_whole, rank)
    paths = list_checkpoints(folder)
    while paths:
        path = paths.pop()
        try:
            checkpoint = checkpoint_format.read(path, device, is_whole, rank)
        except GoneCheckpoint:  # deleted, as its run has saved another
            paths, messages = list_checkpoints(folder), []
            continue
        except DamagedCheckpoint as error:
            messages.append(str(error))
            continue
        for message in messages:
            warnings.warn(f"{message}; using {path.name} instead", stacklevel=2)
        return checkpoint
    if messages:
        raise CheckpointError(f"Every checkpoint in {folder} is damaged: {'; '.join(messages)}")
    raise CheckpointError(f"There is no checkpoint in {folder}; has the run saved one yet?")


def is_intact(path: Path) -> bool:
    """Returns whether a checkpoint is whole: every file is the one that was written."""
    try:
        manifest = checkpoint_format.read_manifest(path)
        with checkpoint_format.verified(path, manifest, manifest["files"]):
            return True
    except CheckpointError:
        return False


def set_aside_after(folder: Path | str, step: int) -> None:
    """Renames checkpoints later than `step` to `step_<N>.aside`, as a run resumes from `step`.

    `save` deletes them once the run reaches their step again.
    """
    for path in list_checkpoints(folder):  # newest last, so it is the latest until then
        if step_of(path) > step:
            aside = path.with_name(f"{path.name}.aside")
            _delete(aside)
            os.replace(path, aside)


def list_checkpoints(folder: Path | str) -> list[Path]:
    """Returns the checkpoints in a folder, oldest first. Skips unfinished and set-aside ones."""
    paths = Path(folder).glob("step_*")
    return sorted((path for path in paths if _NAME.fullmatch(path.name)), key=_step_and_number)


def step_of(path: Path) -> int:
    """Returns the step in a checkpoint's folder name."""
    return _step_and_number(path)[0]


def _step_and_number(path: Path) -> tuple[int, int]:
    """Returns a checkpoint's step, and its number among those of that step, from 1."""
    match = re.match(r"step_(\d+)(?:-(\d+))?", path.name)
    assert match is not None
    step, number = match.groups()
    return int(step), int(number or 1)


def _next_name(folder: Path, step: int) -> str:
    """Returns `step_<N>`, or `step_<N>-2` and so on if the step has checkpoints already."""
    pairs = map(_step_and_number, list_checkpoints(folder))
    last = max((number for other_step, number in pairs if other_step == step), default=0)
    return f"step_{step}-{last + 1}" if last else f"step_{step}"


def _prune(folder: Path, keep_checkpoints: int, step: int) -> None:
    """Deletes old checkpoints, and set-aside ones up to `step`.

    Keeps the last `keep_checkpoints` steps, the step with the best score and the last step with a
    replay buffer; of each step, only the last checkpoint.
    """
    checkpoints = list_checkpoints(folder)
    last_of_each_step = list({step_of(path): path for path in checkpoints}.values())
    scored = [(path, _score(path)) for path in last_of_each_step]
    scores = {path: score for path, score in scored if score is not None}
    best = max(scores, key=scores.__getitem__, default=None)
    with_replay = [path for path in last_of_each_step if (path / "replay.pt").exists()]
    kept = {*last_of_each_step[-keep_checkpoints:], best, *with_replay[-1:]}
    aside = [path for path in folder.glob("step_*.aside") if step_of(path) <= step]
    for path in [*(path for path in checkpoints if path not in kept), *aside]:
        _delete(path)


def _score(path: Path) -> float | None:
    try:
        return checkpoint_format.read_manifest(path)["score"]
    except CheckpointError:
        return None


def _delete(path: Path) -> None:
    """Deletes a checkpoint. If killed midway, leaves a temporary folder, not a damaged one."""
    leftover = temporary_path(path)
    try:
        os.replace(path, leftover)
    except OSError:  # it does not exist or cannot be moved
        return
    shutil.rmtree(leftover, ignore_errors=True)
