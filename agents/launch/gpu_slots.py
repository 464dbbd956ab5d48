"""The GPUs of a sweep's jobs. A *slot* is as many of this machine's GPUs as a job has ranks.

Jobs know of each other by locks on temporary files, one for each GPU and each job on it; the system
drops them when a process ends.
"""

import contextlib
import itertools
import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from megastep.agents.distributed import environment
from megastep.agents.errors import ConfigErrors
from megastep.agents.factory import settings
from megastep.agents.launch import gpu, launcher

#: The environment variable with the GPUs that a process sees.
VISIBLE = "CUDA_VISIBLE_DEVICES"


def check(jobs: Sequence[Any], hydra: Any) -> str | None:
    """Checks that each job has a GPU for every rank, before the first begins. Returns a sentence
    about GPUs that stay idle, None if none does.

    Args:
        jobs: the settings of each job.
        hydra: Hydra's part of the configuration.

    Raises:
        ConfigErrors: a job has more ranks than GPUs, or its launcher would run it several times.
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


def _check_on_node(cfg, n_gpus):
    # a job of Slurm's is given so many GPUs; those of this machine do not matter
    if not n_gpus or cfg.ranks == "all" or cfg.device == "cpu":
        return None
    given = f"hydra.launcher.gpus_per_node={n_gpus}"
    if cfg.ranks > n_gpus:
        text = f"{cfg.ranks} is more than {given}, and a job is on one node; docs/scaling.md has a"
        raise ConfigErrors([("ranks", f"{text} script for several nodes")])
    if cfg.ranks < n_gpus:
        return f"Jobs with ranks={cfg.ranks} leave {n_gpus - cfg.ranks} idle of {given}."


def idle(n_ranks: int, n_gpus: int, is_parallel: bool) -> str | None:
    """Returns a sentence about the GPUs of this machine that jobs leave idle, None if none is.

    Args:
        n_ranks: of a job, at most `n_gpus`.
        is_parallel: jobs run side by side.
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
def taken(cfg: Any) -> Iterator[Any]:
    """Takes a slot for a job, one with the fewest jobs on it, as long as this context lasts.

    Ranks are other processes, and see the GPUs of their slot only. A job of this process gets its
    GPU as PyTorch's current one, which device=auto means. A job with a device of its own takes no
    slot.

    Args:
        cfg: the job's settings.

    Yields:
        The settings, with the number of the GPU if they have device=cuda.
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


def _has_ranks(cfg):
    return isinstance(cfg, settings.Train) and launcher.is_needed(cfg)


def _names(n_gpus):
    # of this process's GPUs, as the variable has them
    if visible := os.environ.get(VISIBLE):
        return [name.strip() for name in visible.split(",")][:n_gpus]
    return [*map(str, range(n_gpus))]


@contextlib.contextmanager
def _locked(names: list[str], size: int) -> Iterator[range]:
    """Locks the first slot that has the fewest jobs on it. Yields the numbers of its GPUs.

    Args:
        names: of this process's GPUs.
        size: number of GPUs of a slot; the first slot begins with the first GPU.
    """
    starts = range(0, len(names) - size + 1, size)
    for n_jobs, start in ((n, start) for n in itertools.count() for start in starts):
        slot = range(start, start + size)
        if locks := _lock([f"{names[i]}-{n_jobs}" for i in slot]):
            with locks:
                yield slot
            return


def _lock(names):
    # all or none, which is None
    import filelock  # which takes a while

    prefix = f"megastep-{os.getuid()}-gpu-"
    with contextlib.suppress(filelock.Timeout), contextlib.ExitStack() as stack:
        for name in names:
            path = Path(tempfile.gettempdir(), prefix + re.sub(r"[^\w-]", "-", name) + ".lock")
            stack.enter_context(filelock.FileLock(path, blocking=False))
        return stack.pop_all()


def _on_gpu(cfg: Any, number: int, stack: contextlib.ExitStack) -> Any:
    """Makes a GPU the current one until the stack ends. Returns the settings of a job on it."""
    import torch

    stack.callback(torch.cuda.set_device, torch.cuda.current_device())
    torch.cuda.set_device(number)
    return settings.changed(cfg, device=f"cuda:{number}") if cfg.device == "cuda" else cfg
