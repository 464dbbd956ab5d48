"""Maps a function over many items in parallel processes."""

from collections.abc import Callable, Sequence
from typing import Any

__all__ = ["MIN_PARALLEL", "WORKER_ENV", "parallel_map"]

MIN_PARALLEL = 48  # fewer items than this are faster without starting processes
CHUNK_SIZE = 8  # items that a process takes at a time

#: Environment variables of a worker process: one thread, no screen, and no GPU, because even an
#: idle CUDA context takes half a gigabyte.
WORKER_ENV = {
    "MPLBACKEND": "Agg",
    "CUDA_VISIBLE_DEVICES": "",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}


def parallel_map(function: Callable[[Any], Any], items: Sequence[Any], description: str) -> list:
    """Returns ``function(item)`` for each item, in order.

    Uses one process per core, and shows a progress bar on stderr, if there are at least
    `MIN_PARALLEL` items. The first exception stops all processes and is raised.

    Args:
        description: the label of the progress bar.
    """
    if len(items) < MIN_PARALLEL:
        return [function(item) for item in items]
    import loky
    from rich.console import Console
    from rich.progress import track

    pool = loky.ProcessPoolExecutor(loky.cpu_count(), env=WORKER_ENV)
    try:
        results = pool.map(function, items, chunksize=CHUNK_SIZE)
        bar = dict(total=len(items), description=description, console=Console(stderr=True))
        results = list(track(results, **bar))
    except BaseException:
        pool.shutdown(wait=True, kill_workers=True)
        raise
    pool.shutdown(wait=True)
    return results
