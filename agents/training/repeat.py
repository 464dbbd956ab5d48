"""Makes a run's NaN or infinity reproducible: keeps the last checkpoint before it."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

from megastep.agents.errors import UserError
from megastep.agents.runs import annealing, checkpoint, folders, typed_json

if TYPE_CHECKING:
    from megastep.agents.algorithms.nonfinite import NonFiniteValue
    from megastep.agents.training.trainer import Trainer

#: Folder in the run folder for that checkpoint; itself a run folder.
FOLDER = "nonfinite"
#: Settings that a resumed run may have changed, and that affect how it continues.
CHANGEABLE = "samples", "seconds", "device", "ranks"


def hint(
    trainer: Trainer, record: annealing.AnnealingRecord, is_resumed: bool, value: NonFiniteValue
) -> str:
    """Returns how to reproduce the first NaN or infinity of a run, as the rest of a sentence: by
    resuming from the last checkpoint, which is kept in a run folder of its own, or, if there is
    none yet, by repeating the run. For rank 0's trainer, before it saves another checkpoint.
    """
    saver = trainer.saver
    saver.wait()
    run = saver.folder.parent
    saved = checkpoint.list_checkpoints(saver.folder)
    if not saved:  # rerun needs a checkpoint at the end, and a policy that diverged is not saved
        if is_resumed or not value.is_from_env:
            return ""
        command = folders.resume_command(run, "rerun")
        return f". To reproduce it, once this run has ended: {command}"
    kept = None
    try:
        before = typed_json.loads((saved[-1] / "config.json").read_bytes())["train"]
        kept = folders.make(run / FOLDER)
        shutil.copytree(saved[-1], kept / "checkpoints" / saved[-1].name)
        record.file.flush()
        shutil.copy2(run / annealing.FILE, kept)
    except (OSError, UserError) as error:
        if kept is not None:
            shutil.rmtree(kept, ignore_errors=True)
        return f". The checkpoint before it could not be kept ({error})"
    now = {key: saver.config["train"][key] for key in CHANGEABLE}
    words = [f"{k}={'null' if x is None else x}" for k, x in now.items() if x != before.get(k)]
    return f". To reproduce it: {' '.join([folders.resume_command(kept), *words])}"
