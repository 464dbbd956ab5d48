"""Checks before training that all ranks run the same code, configuration and environments, and see
the same run folder. A single process has nothing to check.
"""

import contextlib
import dataclasses
import hashlib
import os
import platform
import secrets
import shutil
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch

from megastep.agents import factory, package
from megastep.agents.distributed import process_group
from megastep.agents.distributed.agreement import from_rank_0, together
from megastep.agents.distributed.drift import ranks_named
from megastep.agents.errors import UserError, user_errors
from megastep.agents.factory import check, settings
from megastep.agents.launch.watch import Team
from megastep.agents.runs import checkpoint, folders, populations, provenance
from megastep.agents.training.trainer import Trainer

#: Seconds within which a file of rank 0 must be visible on the other machines.
SHARED_SECONDS = 10.0


def check_start(cfg: settings.Train) -> None:
    """Raises UserError if the ranks differ in versions, code or configuration."""
    if process_group.n_ranks() > 1:
        facts = {
            "torch": torch.__version__,
            "CUDA": torch.version.cuda,
            "NumPy": np.__version__,
            "Python": platform.python_version(),
            "megastep": package.version(),
            "the commit of the checkout": provenance.commit(package.ROOT),
        }
        check_equal(facts | dict(check.leaves(check.as_tree(cfg))))


def check_world(cfg: settings.Train, trainer: Trainer) -> None:
    """Raises UserError if the ranks differ in geometries or spaces."""
    if process_group.n_ranks() > 1:
        homes = factory.homes(cfg.env, cfg.geometry, "training")
        facts = {"the digest of the training homes": digest(homes)}
        check_equal(facts | trainer.saver.config["spaces"])


def check_equal(facts: dict[str, object]) -> None:
    """Compares facts, such as versions and settings, of all ranks. Waits for the other ranks.

    Args:
        facts: this rank's facts by name, the most important first.

    Raises:
        UserError: with the first that differs, such as `learner.lr is 0.001 on rank 0, and 0.01 on
            ranks 1 and 3`.
    """
    everyones = process_group.gather_objects({name: str(value) for name, value in facts.items()})
    for name in dict.fromkeys(name for theirs in everyones for name in theirs):
        holders: dict[str, list[int]] = {}
        for rank, theirs in enumerate(everyones):
            holders.setdefault(theirs.get(name, "missing"), []).append(rank)
        if len(holders) > 1:
            values = (f"{value} on {ranks_named(ranks)}" for value, ranks in holders.items())
            raise UserError(
                f"The ranks differ: {name} is {', and '.join(values)}; start all with the same "
                "code, packages and options"
            )


def digest(homes: Iterable[dict]) -> str:
    """Returns a hash of geometries, 16 hexadecimal digits."""
    total = hashlib.sha256()
    for home in homes:
        for name in sorted(home):
            value = np.asarray(home[name])
            total.update(f"{name} {value.dtype} {value.shape}".encode())
            total.update(str(value).encode() if value.dtype == object else value.tobytes())
    return total.hexdigest()[:16]


def check_shared(folder: Path) -> str:
    """Checks that all ranks see the run folder of rank 0.

    Returns:
        A random name of this start, the same on all ranks.

    Raises:
        UserError: on all ranks, if one of them does not see the folder.
    """
    name = from_rank_0(secrets.token_hex)
    if process_group.n_ranks() == 1:
        return name
    path = folder / f".ranks-{name}"

    def wait_for_file() -> None:
        deadline = time.monotonic() + SHARED_SECONDS
        while not (folder.is_dir() and path.name in os.listdir(folder)):
            if time.monotonic() > deadline:
                raise UserError(
                    f"The run folder {folder.absolute()} of rank 0 is not here; start all ranks "
                    "in one folder that their machines share, or give folder= with a path there"
                )
            time.sleep(0.1)

    with user_errors(folders.CANNOT.format(folder)):
        from_rank_0(path.touch)
    try:
        together(wait_for_file)
    finally:
        if process_group.rank() == 0:
            path.unlink(missing_ok=True)
    return name


def started_again(cfg: settings.Train, team: Team | None) -> settings.Train:
    """Returns the settings for this attempt. After a restart by torchrun, they resume the run from
    its last checkpoint, or start again if there is none.
    """
    folder = from_rank_0(lambda: team and team.earlier_folder())
    if folder is None:
        return cfg

    def totals() -> dict[str, float] | None:
        path = folder if checkpoint.list_checkpoints(folder / "checkpoints") else None
        if populations.is_root(folder):
            with contextlib.suppress(UserError):
                path = populations.common_checkpoints(folder)[0]
        if path is None:
            if not cfg.resume:
                shutil.rmtree(folder, ignore_errors=True)
            return None
        saved = folders.load_checkpoint(path, cfg.trust).config["train"]
        return {name: saved[name] for name in ("samples", "seconds")}

    if limits := from_rank_0(totals):
        limits |= dict(more_samples=None, more_seconds=None, init=None, folder=None)
        return dataclasses.replace(cfg, resume=str(folder), **limits)
    return cfg if cfg.resume else dataclasses.replace(cfg, folder=str(folder))
