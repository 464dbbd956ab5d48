"""Makes a run's NaN or infinity reproducible: keeps the last checkpoint before it."""

from __future__ import annotations

import contextlib
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from megastep.agents.errors import UserError
from megastep.agents.runs import annealing, checkpoint, folders, typed_json

if TYPE_CHECKING:
    from megastep.agents.algorithms.nonfinite import NonFiniteValue
    from megastep.agents.training.trainer import Trainer
    from megastep.agents.types import Config

#: Folder in the run folder for that checkpoint; itself a run folder.
FOLDER = "nonfinite"
#: Settings that a resumed run may have changed, and that affect how it continues.
CHANGEABLE = "samples", "seconds", "device", "ranks"


def hint(
    trainer: Trainer,
    record: annealing.AnnealingRecord,
    is_resumed: bool,
    value: NonFiniteValue,
) -> str:
    """Returns how to reproduce the first NaN or infinity of a run, as the rest of a sentence.

    Resuming from the last checkpoint reproduces it bit for bit, so that checkpoint is kept, in a
    run folder of its own. If there is none yet, or checkpoints do not hold everything, the run must
    be repeated from its first update.

    Args:
        trainer: rank 0's trainer, before it saves another checkpoint.
        record: the run's.
        is_resumed: this process resumed the run.
        value: the first NaN or infinity.
    """
    saver = trainer.saver
    saver.wait()
    run = saver.folder.parent
    saved = checkpoint.list_checkpoints(saver.folder)
    whole = [path for path in saved if _is_whole(path, trainer)]
    reason = trainer.run_state.incomplete()
    if saved and not whole:
        reason = reason or "they lack episodes or the replay buffer"
    try:
        if whole and not reason:
            changed = _changed(whole[-1], saver.config["train"])
            if "seconds" not in changed or trainer.budget.anneal != "seconds":
                path = _keep(whole[-1], run, record)
                words = [f"{key}={'null' if now is None else now}" for key, now in changed.items()]
                return f". To reproduce it: {' '.join([folders.resume_command(path), *words])}"
            reason = "seconds= has changed since the last one, and with it the learning rate"
    except (OSError, UserError) as error:
        return f". The checkpoint before it could not be kept ({error})"
    why = f". Checkpoints cannot repeat it, as {reason}" if reason else ""
    # rerun needs a checkpoint at the end, and a policy that diverged is not saved
    if is_resumed or not value.is_from_env:
        return why
    how = "To try from the start" if reason else "To reproduce it"
    return f"{why}. {how}, once this run has ended: {folders.resume_command(run, 'rerun')}"


def _is_whole(path, trainer) -> bool:
    """Returns True if a checkpoint has environments, and the replay buffer if there is one."""
    has_replay = trainer.run_state.replay_buffer is None or (path / "replay.pt").exists()
    return has_replay and (path / "world.pt").exists()


def _changed(path: Path, config: Config) -> Config:
    """Returns the settings in `CHANGEABLE` whose values differ from the checkpoint's."""
    before = typed_json.loads((path / "config.json").read_bytes())["train"]
    return {key: config[key] for key in CHANGEABLE if config[key] != before.get(key)}


def _keep(path, run, record) -> Path:
    """Creates a run folder with the checkpoint and the annealing record. Returns the folder."""
    kept = folders.make(run / FOLDER)
    try:
        shutil.copytree(path, kept / "checkpoints" / path.name, copy_function=_link)
        record.file.flush()
        shutil.copy2(run / annealing.FILE, kept)
    except OSError:
        shutil.rmtree(kept, ignore_errors=True)
        raise
    return kept


def _link(source, target) -> str:
    """Hard-links a file, since checkpoints never change; copies it where links fail."""
    with contextlib.suppress(OSError):
        os.link(source, target)
        return target
    return shutil.copy2(source, target)
