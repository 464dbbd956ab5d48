"""What worker processes have in common."""

import contextlib
import signal
from collections.abc import Iterator

__all__ = ["WORKER_ENV", "terminal_signals_blocked"]

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
    """Processes started inside never receive Ctrl-C or SIGHUP; whoever starts them stops them.

    A terminal sends both to every process it runs, and a child inherits its parent's signal mask.
    """
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)
