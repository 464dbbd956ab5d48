"""Assigns the GPUs of this machine, in turn, to a sweep's jobs: a *slot* has one per rank."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from typing import Any, TypeGuard

from megastep.agents.errors import ConfigErrors
from megastep.agents.factory import settings
from megastep.agents.launch import gpu, launcher

#: Environment variable with the GPUs that a process may use.
VISIBLE = "CUDA_VISIBLE_DEVICES"


def check(jobs: Sequence, hydra: Any) -> None:
    """Raises ConfigErrors for more ranks than GPUs, or a launcher that repeats each job."""
    kind, options = hydra.runtime.choices["hydra/launcher"], hydra.launcher
    elsewhere = "a job is one task on one node; docs/scaling.md has a script for several nodes"
    for key in ("nodes", "tasks_per_node"):
        if (n_times := options.get(key) or 1) > 1:
            text = f"{n_times} would run each job {n_times} times; {elsewhere}"
            raise ConfigErrors([(f"hydra.launcher.{key}", text)])
    for cfg in filter(_has_ranks, jobs):
        if kind != "submitit_slurm":
            launcher.n_ranks(cfg)
            continue
        # Slurm assigns the GPUs, so those of this machine do not matter
        n_gpus = options.get("gpus_per_node") or 0
        if n_gpus and cfg.ranks != "all" and cfg.device != "cpu" and int(cfg.ranks) > n_gpus:
            text = f"{cfg.ranks} is more than hydra.launcher.gpus_per_node={n_gpus}; {elsewhere}"
            raise ConfigErrors([("ranks", text)])


@contextlib.contextmanager
def taken(cfg: settings.Common, number: int) -> Iterator[settings.Common]:
    """Gives a job a slot, by its number in the sweep, for the context. Ranks see only its GPUs; for
    a job in this process it is PyTorch's current device, and in the settings that are yielded.
    """
    n_gpus = gpu.count() if cfg.device in ("auto", "cuda") else 0
    if n_gpus < 2:
        yield cfg
        return
    size = launcher.n_ranks(cfg) if _has_ranks(cfg) else 1
    first = number % (n_gpus // size) * size
    if _has_ranks(cfg):
        # as CUDA_VISIBLE_DEVICES names them: by UUIDs, or numbers other than PyTorch's
        before = os.environ.get(VISIBLE)
        names = (before or ",".join(map(str, range(n_gpus)))).split(",")
        os.environ[VISIBLE] = ",".join(name.strip() for name in names[first : first + size])
        try:
            yield cfg
        finally:
            del os.environ[VISIBLE]
            if before is not None:
                os.environ[VISIBLE] = before
        return
    import torch

    current = torch.cuda.current_device()
    torch.cuda.set_device(first)
    try:
        yield settings.changed(cfg, device=f"cuda:{first}") if cfg.device == "cuda" else cfg
    finally:
        torch.cuda.set_device(current)


def _has_ranks(cfg: settings.Common) -> "TypeGuard[settings.Train]":
    return isinstance(cfg, settings.Train) and launcher.is_needed(cfg)
