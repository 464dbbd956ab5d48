"""Maps a function over many items in parallel processes."""

import contextlib
import signal
from collections.abc import Callable, Iterator, Sequence
from typing import Any

__all__ = ["MIN_PARALLEL", "WORKER_ENV", "parallel_map", "terminal_signals_blocked"]

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
    `MIN_PARALLEL` items. The first exception stops all processes and is raised, and so does a
    signal whose handler raises one.

    Args:
        description: the label of the progress bar.
    """
    if len(items) < MIN_PARALLEL:
        return [function(item) for item in items]
    import loky
    from rich.console import Console
    from rich.progress import track

    chunks = [items[i : i + CHUNK_SIZE] for i in range(0, len(items), CHUNK_SIZE)]
    with terminal_signals_blocked():
        pool = loky.ProcessPoolExecutor(loky.cpu_count(), env=WORKER_ENV)
    try:
        # not pool.map: interrupted, it cancels futures, and killing the workers then fails on them
        with terminal_signals_blocked():
            futures = [pool.submit(_map, function, chunk) for chunk in chunks]
        bar = track(futures, description=description, console=Console(stderr=True))
        results = [result for future in bar for result in future.result()]
    except BaseException:
        pool.shutdown(wait=True, kill_workers=True)
        raise
    pool.shutdown(wait=True)
    return results


def _map(function, items):
    return [function(item) for item in items]


@contextlib.contextmanager
def terminal_signals_blocked() -> Iterator[None]:
    """Processes started inside never receive Ctrl-C or SIGHUP; whoever starts them stops them.

    A terminal sends both to every process it runs, and a child inherits its parent's signal mask.
    """
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)
