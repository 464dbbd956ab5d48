"""`resume=auto`: one command that starts a run, and continues it when it is repeated.

Clusters repeat a job's command after a preemption, a time limit or the loss of a machine.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from megastep.agents.errors import ConfigErrors, shortened
from megastep.agents.factory import check, settings
from megastep.agents.runs import checkpoint, folders
from megastep.agents.training.budget import evaluation_in, reaches

#: The value of `resume` that continues the run in `folder`, if there is one.
AUTO = "auto"
#: Environment variable with the id of a Slurm job, which a requeued job keeps.
SLURM_JOB = "SLURM_JOB_ID"
#: Settings that may change when a run is resumed: where it runs, when it stops and which files it
#: writes, but nothing that decides what it learns.
RESUMABLE = (
    "resume",
    "samples",
    "seconds",
    "more_samples",
    "more_seconds",
    "device",
    "trust",
    "logging",
    "evaluation",
    "checkpoints",
    "desync",
    "ranks",
    "restarts",
    "dry_run",
    "logger",
    "finish",
)


class Start(NamedTuple):
    """How to start or continue a run.

    Attributes:
        cfg: settings to train with; `resume` is still `AUTO` if the run has saved nothing yet.
        folder: the run folder.
        is_done: True if the run has used up its budget, or reached `stop`.
        is_reached: True if it has reached `stop`.
    """

    cfg: settings.Train
    folder: Path
    is_done: bool = False
    is_reached: bool = False


def with_more(cfg: settings.Train) -> settings.Train:
    """Returns `cfg` with more_samples and more_seconds turned into totals of the resumed run."""
    totals = {}
    for name in ("samples", "seconds"):
        if (more := getattr(cfg, f"more_{name}")) is not None and cfg.resume:
            had = folders.load_checkpoint(folders.find(cfg.resume), cfg.trust).numbers[name]
            totals |= {name: had + more, f"more_{name}": None}
    return settings.changed(cfg, **totals)


def folder_of(cfg: settings.Train) -> Path:
    """Returns the folder of the run to start or continue.

    Raises:
        ConfigErrors: `folder` is missing, and this is not a Slurm job.
    """
    if cfg.folder is not None:
        return Path(cfg.folder)
    if number := os.environ.get(SLURM_JOB):
        return folders.RUNS / folders.for_file(f"slurm-{number}")
    text = f"is needed with resume=auto, outside jobs of Slurm: folder={folders.RUNS}/NAME"
    raise ConfigErrors([("folder", text)])


def automatic(cfg: settings.Train) -> Start:
    """Decides whether `resume=auto` starts a run, continues it or has nothing left to do.

    Raises:
        ConfigErrors: a setting outside `RESUMABLE` differs from the run's, or `more_samples` or
            `more_seconds` is given.
        UserError: the folder holds something other than a run, or no intact checkpoint.
    """
    for key in ("more_samples", "more_seconds"):
        if getattr(cfg, key) is not None:
            text = f"would be added each time; with resume=auto give the total, {key[5:]}="
            raise ConfigErrors([(key, text)])
    folder = folder_of(cfg)
    cfg = settings.changed(cfg, folder=str(folder))
    if not has_checkpoint(folder):
        folders.check_free(cfg.folder, is_again=True)
        return Start(cfg, folder)
    loaded = folders.load_checkpoint(folders.find(str(cfg.folder)), cfg.trust)
    if errors := [*_differences(loaded.config["train"], check.as_tree(cfg))]:
        raise ConfigErrors(errors)
    numbers = loaded.numbers
    budgets = {name: getattr(cfg, name) for name in ("samples", "seconds")}
    is_done = any(limit is not None and numbers[name] >= limit for name, limit in budgets.items())
    is_reached = reaches(evaluation_in(numbers), cfg.evaluation.stop)
    cfg = settings.changed(cfg, resume=str(folder), folder=None, init=None)
    return Start(cfg, folder, is_done or is_reached, is_reached)


def has_checkpoint(folder: Path) -> bool:
    """Returns whether a run in a folder has saved anything, whole or damaged."""
    return bool(checkpoint.list_checkpoints(folder / "checkpoints"))


def _differences(saved, typed) -> Iterator[tuple[str, str]]:
    """Yields (key, error) for settings outside `RESUMABLE` that differ from the saved ones."""
    free = {*RESUMABLE, "folder", "init"}
    if typed["learner"].get("anneal") == "auto":  # decided when the run began
        free.add("learner.anneal")
    before = dict(check.leaves(saved))
    for key, value in check.leaves(typed):
        is_free = {key, key.partition(".")[0]} & free
        if not is_free and key in before and before[key] != value:
            was, cure = shortened(before[key], 60), "choose another folder, or init=RUN"
            yield key, f"was {was} when the run began; {cure}"
