"""Assigns the GPUs of this machine to the jobs of a sweep. A *slot* is a job's GPUs, one per rank.

Jobs may run in separate processes, so they count each other by lock files, one per GPU and job on
it. The system releases a lock when its process ends.
"""

import contextlib
import itertools
import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard, TypeVar

from megastep.agents.distributed import environment
from megastep.agents.errors import ConfigErrors
from megastep.agents.factory import settings
from megastep.agents.launch import gpu, launcher

if TYPE_CHECKING:
    from contextlib import ExitStack

T = TypeVar("T", bound=settings.Common)

#: Environment variable with the GPUs that a process may use.
VISIBLE = "CUDA_VISIBLE_DEVICES"


def check(jobs: Sequence, hydra: Any) -> str | None:
    """Checks that every job has a GPU per rank, before the first job starts.

    Args:
        jobs: the settings of each job.
        hydra: Hydra's part of the configuration.

    Returns:
        A sentence about idle GPUs; None if there are none.

    Raises:
        ConfigErrors: a job has more ranks than there are GPUs, or Hydra's launcher would run each
            job several times.
    """
    kind, options = hydra.runtime.choices["hydra/launcher"], hydra.launcher
    for key in ("nodes", "tasks_per_node"):
        if (n_times := options.get(key) or 1) > 1:
            text = (
                f"{n_times} would run each job {n_times} times; a job is one task on one node, and"
            )
            text = f"{text} starts its ranks itself; docs/scaling.md has a script for several nodes"
            raise ConfigErrors([(f"hydra.launcher.{key}", text)])
    hints = []
    for cfg in filter(_has_ranks, jobs):
        if kind == "submitit_slurm":
            hints.append(_check_on_node(cfg, options.get("gpus_per_node") or 0))
            continue
        n_ranks, n_gpus = launcher.n_ranks(cfg), gpu.count() if cfg.device != "cpu" else 0
        if n_ranks > 1 and n_gpus and len(jobs) > 1:
            hints.append(idle(n_ranks, n_gpus, is_parallel=kind != "basic"))
    return next(filter(None, hints), None)


def _check_on_node(cfg, n_gpus) -> str | None:
    # Slurm assigns the GPUs, so those of this machine do not matter
    if not n_gpus or cfg.ranks == "all" or cfg.device == "cpu":
        return None
    given = f"hydra.launcher.gpus_per_node={n_gpus}"
    if cfg.ranks > n_gpus:
        text = f"{cfg.ranks} is more than {given}, and a job is on one node; docs/scaling.md has a"
        raise ConfigErrors([("ranks", f"{text} script for several nodes")])
    if cfg.ranks < n_gpus:
        return f"Jobs with ranks={cfg.ranks} leave {n_gpus - cfg.ranks} idle of {given}."


def idle(n_ranks: int, n_gpus: int, is_parallel: bool) -> str | None:
    """Returns a sentence about the GPUs that jobs leave idle; None if there are none.

    Args:
        n_ranks: ranks per job, at most `n_gpus`.
        n_gpus: GPUs of this machine.
        is_parallel: jobs run at the same time.
    """
    n_slots = n_gpus // n_ranks
    n_idle = n_gpus - n_ranks * (n_slots if is_parallel else 1)
    if not n_idle:
        return None
    if is_parallel or n_slots == 1:
        return f"Jobs with ranks={n_ranks} leave {n_idle} of {n_gpus} GPUs idle."
    which = f"Jobs with ranks={n_ranks} that run one after another"
    cure = f"hydra/launcher=joblib hydra.launcher.n_jobs={n_slots} runs {n_slots} at a time"
    return f"{which} leave {n_idle} of {n_gpus} GPUs idle; {cure}."


@contextlib.contextmanager
def taken(cfg: T) -> Iterator[T]:
    """Takes the slot with the fewest jobs for the duration of the context.

    Ranks are separate processes and see only the GPUs of their slot. For a job in this process, the
    GPU becomes PyTorch's current device, which device=auto uses. A job with device=cpu or cuda:1
    takes no slot.

    Args:
        cfg: the job's settings.

    Yields:
        The settings; device=cuda is replaced by the GPU's number, such as cuda:1.
    """
    n_gpus = gpu.count() if cfg.device in ("auto", "cuda") else 0
    with contextlib.ExitStack() as stack:
        if n_gpus > 1:
            names = _names(n_gpus)
            if _has_ranks(cfg):
                slot = stack.enter_context(_locked(names, launcher.n_ranks(cfg)))
                visible = {VISIBLE: ",".join(names[i] for i in slot)}
                stack.enter_context(environment.variables(visible))
            else:
                (number,) = stack.enter_context(_locked(names, 1))
                cfg = _on_gpu(cfg, number, stack)
        yield cfg


def _has_ranks(cfg: settings.Common) -> "TypeGuard[settings.Train]":
    return isinstance(cfg, settings.Train) and launcher.is_needed(cfg)


def _names(n_gpus) -> list[str]:
    # as CUDA_VISIBLE_DEVICES names them: by UUIDs, or numbers other than PyTorch's
    if visible := os.environ.get(VISIBLE):
        return [name.strip() for name in visible.split(",")][:n_gpus]
    return [*map(str, range(n_gpus))]


@contextlib.contextmanager
def _locked(names: list[str], size: int) -> Iterator[range]:
    """Locks the first of the slots with the fewest jobs. Yields the indices of its GPUs.

    Args:
        names: names of this process's GPUs.
        size: GPUs per slot; the first slot starts at the first GPU.
    """
    starts = range(0, len(names) - size + 1, size)
    for n_jobs, start in ((n, start) for n in itertools.count() for start in starts):
        slot = range(start, start + size)
        if locks := _lock([f"{names[i]}-{n_jobs}" for i in slot]):
            with locks:
                yield slot
            return


def _lock(names) -> "ExitStack | None":
    # returns all locks, or None if one is taken
    import filelock  # slow to import

    prefix = f"megastep-{os.getuid()}-gpu-"
    with contextlib.suppress(filelock.Timeout), contextlib.ExitStack() as stack:
        for name in names:
            path = Path(tempfile.gettempdir(), prefix + re.sub(r"[^\w-]", "-", name) + ".lock")
            stack.enter_context(filelock.FileLock(path, blocking=False))
        return stack.pop_all()


def _on_gpu(cfg: T, number: int, stack: contextlib.ExitStack) -> T:
    """Makes a GPU the current device until the stack closes. Returns settings that use it."""
    import torch

    stack.callback(torch.cuda.set_device, torch.cuda.current_device())
    torch.cuda.set_device(number)
    return settings.changed(cfg, device=f"cuda:{number}") if cfg.device == "cuda" else cfg
