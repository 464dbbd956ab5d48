"""`resume=auto`: starts a run, or continues it when a cluster repeats the command."""

import os
from pathlib import Path

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
    "resume samples seconds more_samples more_seconds device trust logging evaluation checkpoints "
    "desync ranks dry_run logger finish"
).split()


def with_more(cfg: settings.Train) -> settings.Train:
    """Returns `cfg` with more_samples and more_seconds turned into totals of the resumed run."""
    totals = {}
    for name in ("samples", "seconds"):
        if (more := getattr(cfg, f"more_{name}")) is not None:
            had = folders.load_checkpoint(folders.find(str(cfg.resume)), cfg.trust).numbers[name]
            totals |= {name: had + more, f"more_{name}": None}
    return settings.changed(cfg, **totals)


def automatic(cfg: settings.Train) -> tuple[settings.Train, str | None]:
    """Returns the settings with which `resume=auto` begins, `AUTO` still if nothing was saved, and
    why nothing is left to do, if so. ConfigErrors if a setting outside `RESUMABLE` differs.
    """
    for key in ("more_samples", "more_seconds"):
        if getattr(cfg, key) is not None:
            text = f"would be added each time; with resume=auto give the total, {key[5:]}="
            raise ConfigErrors([(key, text)])
    if cfg.folder is not None:
        folder = Path(cfg.folder)
    elif number := os.environ.get(SLURM_JOB):
        folder = folders.RUNS / folders.for_file(f"slurm-{number}")
    else:
        text = f"is needed with resume=auto, outside jobs of Slurm: folder={folders.RUNS}/NAME"
        raise ConfigErrors([("folder", text)])
    if not checkpoint.list_checkpoints(folder / "checkpoints"):  # whole or damaged
        folders.check_free(str(folder), is_again=True)
        return settings.changed(cfg, folder=str(folder)), None
    loaded = folders.load_checkpoint(folders.find(str(folder)), cfg.trust)
    typed, before = check.as_tree(cfg), dict(check.leaves(loaded.config["train"]))
    free, errors = {*RESUMABLE, "folder", "init"}, []
    if typed["learner"].get("anneal") == "auto":  # decided when the run began
        free.add("learner.anneal")
    for key, value in check.leaves(typed):
        is_free = {key, key.partition(".")[0]} & free
        if not is_free and key in before and before[key] != value:
            was, cure = shortened(before[key], 60), "choose another folder, or init=RUN"
            errors.append((key, f"was {was} when the run began; {cure}"))
    if errors:
        raise ConfigErrors(errors)
    numbers, ended = loaded.numbers, None
    budgets = {name: getattr(cfg, name) for name in ("samples", "seconds")}
    if any(limit is not None and numbers[name] >= limit for name, limit in budgets.items()):
        ended = "used up its budget"
    if reaches(evaluation_in(numbers), cfg.evaluation.stop):
        ended = "reached its stop"
    return settings.changed(cfg, resume=str(folder), folder=None, init=None), ended
