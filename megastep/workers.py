"""What worker processes have in common."""

import contextlib
import functools
import multiprocessing.resource_tracker
import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Executor

#: Environment variables of a worker process: one thread, no screen, and no GPU, because even an
#: idle CUDA context takes half a gigabyte.
WORKER_ENV = {
    "MPLBACKEND": "Agg",
    "CUDA_VISIBLE_DEVICES": "",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}


@contextlib.contextmanager
def terminal_signals_blocked() -> Iterator[None]:
    """Processes started inside inherit a mask: a terminal's Ctrl-C or SIGHUP never reaches them."""
    signals = {signal.SIGINT, signal.SIGHUP}
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        # A process of multiprocessing's, which pools start with their first worker. It lives on,
        # so SIGHUP must not reach it either; its start unblocks SIGINT (CPython's issue 127586).
        multiprocessing.resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, signals)
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)


@functools.cache
def end_with_parent(parent: int) -> None:
    """Sends this process SIGTERM within a second of the end of ``parent``, its parent."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


def pool(n_workers: int) -> Executor:
    """Returns a pool of processes with :data:`WORKER_ENV`, which end with this one. Its first
    workers start with the first call, which belongs inside :func:`terminal_signals_blocked`.
    """
    import loky

    parent = (os.getpid(),)
    return loky.ProcessPoolExecutor(
        n_workers, initializer=end_with_parent, initargs=parent, env=WORKER_ENV
    )
