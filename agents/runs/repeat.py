"""How to meet a run's NaN or infinity again: from the last checkpoint before it, which is kept."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from megastep.agents.errors import UserError
from megastep.agents.runs import annealing, checkpoint, folders

if TYPE_CHECKING:
    from megastep.agents.algorithms.nonfinite import NonFiniteValue
    from megastep.agents.training.trainer import Trainer
    from megastep.agents.types import Config

#: The run folder, in that of the run, in which the checkpoint is kept.
FOLDER = "nonfinite"
#: Settings that may have changed since a checkpoint and decide how a run goes on from it.
CHANGEABLE = "samples", "seconds", "device", "ranks"


def hint(trainer: Trainer, value: NonFiniteValue, is_resumed: bool) -> str:
    """Returns how to meet the first NaN or infinity of a run again, as the rest of a sentence.

    A run that is resumed meets it bit for bit. Its checkpoint is kept in a run folder of its own,
    so the run goes on as it would have. Where checkpoints do not hold everything, or there is none
    yet, the run has to be repeated from its first update.

    Args:
        trainer: of rank 0, before it saves another checkpoint.
        value: what was found.
        is_resumed: this process resumed the run, so its first update was elsewhere.
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
                path = _keep(whole[-1], run, trainer)
                words = [f"{key}={'null' if now is None else now}" for key, now in changed.items()]
                return f". To see it again: {' '.join([folders.resume_command(path), *words])}"
            reason = "the learning rate has followed another clock since the last one"
    except (OSError, UserError) as error:
        return f". The checkpoint before it could not be kept ({error})"
    why = f". Checkpoints cannot repeat it, as {reason}" if reason else ""
    # rerun needs a checkpoint at the end, and a policy that diverged is not saved
    if is_resumed or not value.is_from_env:
        return why
    how = "To try from the start" if reason else "To see it again"
    return f"{why}. {how}, once this run has ended: {folders.resume_command(run, 'rerun')}"


def _is_whole(path, trainer) -> bool:
    """Returns whether a checkpoint holds episodes, and the replay buffer if there is one."""
    has_replay = trainer.run_state.replay_buffer is None or (path / "replay.pt").exists()
    return has_replay and (path / "world.pt").exists()


def _changed(path: Path, config: Config) -> Config:
    """Returns the settings that a checkpoint has other values of."""
    before = json.loads((path / "config.json").read_bytes())["train"]
    return {key: config[key] for key in CHANGEABLE if config[key] != before.get(key)}


def _keep(path, run, trainer) -> Path:
    """Makes a run folder with a checkpoint and the learning rates since. Returns the folder."""
    kept = folders.make(run / FOLDER)
    try:
        shutil.copytree(path, kept / "checkpoints" / path.name, copy_function=_link)
        if trainer.annealing_record is not None:
            trainer.annealing_record.flush()
            shutil.copy2(run / annealing.FILE, kept)
    except OSError:
        shutil.rmtree(kept, ignore_errors=True)
        raise
    return kept


def _link(source, target) -> str:
    """Gives a file a second name: checkpoints never change. Copies it where that is impossible."""
    with contextlib.suppress(OSError):
        os.link(source, target)
        return target
    return shutil.copy2(source, target)
