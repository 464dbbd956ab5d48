"""The record of how the learning rate fell: its factor in each update, a float64 each.

What the clock decided is in it, so a run can be repeated: `megastep rerun RUN`.
"""

import contextlib
import math
from array import array
from pathlib import Path

from megastep.agents.runs import strange_files
from megastep.agents.runs.atomic_files import AppendedFile

FILE, MAX_BYTES = "annealing.f64", 2**32


def read(folder: Path | str) -> array:
    """Returns the factors of a run's updates, in order; none if there is no record. NaN stands for
    those of an earlier version, which recorded none.
    """
    factors, path = array("d"), Path(folder) / FILE
    if path.exists():
        data = strange_files.read_bytes(path, MAX_BYTES)
        factors.frombytes(data[: len(data) // factors.itemsize * factors.itemsize])
    return factors


class AnnealingRecord:
    """Appends to a run's record.

    Args:
        folder: the run folder.
        n_updates: updates that the run has had. Later factors are removed; missing ones, of a run
            that an earlier version began, are NaN.

    Raises:
        OSError: the file cannot be written.
    """

    def __init__(self, folder: Path | str, n_updates: int = 0):
        n_kept = min(n_updates, len(read(folder)))
        self.file = AppendedFile(Path(folder) / FILE, n_kept * array("d").itemsize)
        for _ in range(n_kept, n_updates):
            self.append(math.nan)

    def append(self, factor: float) -> None:
        """Adds the factor of an update. It is written with the next report."""
        self.file.unwritten += array("d", [factor]).tobytes()

    def flush(self) -> None:
        """Writes what was added."""
        self.file.flush()

    def sync(self) -> None:
        """Writes what was added and flushes it to disk."""
        self.file.sync()

    def close(self) -> None:
        """Writes what was added, if the disk has room for it."""
        with contextlib.suppress(OSError):
            self.file.close()
