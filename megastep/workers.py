"""Work that all cores of the machine share, in processes of their own."""

from collections.abc import Callable, Sequence
from typing import Any

__all__ = ["ENV", "mapped"]

MANY = 48  # items from which on starting processes pays
CHUNK = 8  # items that a process takes at a time

#: The environment variables of a worker: it works on one thread, never draws on a screen, and sees
#: no GPU, as even an idle CUDA context is half a gigabyte.
ENV = {
    "MPLBACKEND": "Agg",
    "CUDA_VISIBLE_DEVICES": "",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}


def mapped(function: Callable[[Any], Any], items: Sequence[Any], what: str) -> list:
    """``function`` of each item, in their order; of many items in processes, with a bar of progress
    that is called ``what`` on the error stream. The first error that it raises ends all.
    """
    if len(items) < MANY:
        return [function(item) for item in items]
    import loky
    from rich.console import Console
    from rich.progress import track

    pool = loky.ProcessPoolExecutor(loky.cpu_count(), env=ENV)
    try:
        results = pool.map(function, items, chunksize=CHUNK)
        bar = dict(total=len(items), description=what, console=Console(stderr=True))
        found = list(track(results, **bar))
    except BaseException:
        pool.shutdown(wait=True, kill_workers=True)
        raise
    pool.shutdown(wait=True)
    return found
