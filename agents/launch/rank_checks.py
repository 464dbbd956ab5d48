"""Checks before training that all ranks run the same code and settings, and see one run folder.
A single process has nothing to check.
"""

import os
import platform
import secrets
import time
from pathlib import Path

import numpy as np
import torch

from megastep.agents import package
from megastep.agents.distributed import process_group
from megastep.agents.distributed.process_group import from_rank_0, together
from megastep.agents.distributed.ranks import ranks_named
from megastep.agents.errors import UserError, user_errors
from megastep.agents.factory import check, settings
from megastep.agents.runs import folders, provenance

#: Seconds within which a file of rank 0 must be visible on the other machines.
SHARED_SECONDS = 10.0


def check_start(cfg: settings.Train) -> None:
    """Raises UserError if the ranks differ in versions, code or settings."""
    if process_group.n_ranks() == 1:
        return
    facts = {
        "torch": torch.__version__,
        "CUDA": torch.version.cuda,
        "NumPy": np.__version__,
        "Python": platform.python_version(),
        "megastep": package.version(),
        "the commit of the checkout": provenance.commit(package.ROOT),
    }
    check_equal(facts | dict(check.leaves(check.as_tree(cfg))))


def check_equal(facts: dict[str, object]) -> None:
    """Compares facts of all ranks by name, the most important first. Raises UserError with the
    first that differs, such as `learner.lr is 0.001 on rank 0, and 0.01 on ranks 1 and 3`.
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


def check_shared(folder: Path) -> str:
    """Checks that all ranks see the run folder of rank 0. Returns a random name of this start, the
    same on all ranks.

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
