"""The annealing record: the learning rate's factor (1 at first) in each update, as one float64.

With `seconds=` the factors depend on the clock; the record lets `megastep rerun` repeat such a run.
"""

import contextlib
import math
from array import array
from pathlib import Path

from megastep.agents.runs import strange_files
from megastep.agents.runs.atomic_files import AppendedFile

FILE, MAX_BYTES = "annealing.f64", 2**32
#: Most updates that may lack a record, because an earlier version made them.
MAX_MISSING = 10**7


def read(folder: Path | str) -> array:
    """Returns the factor of each update of a run; empty without a record. NaN marks updates made by
    versions that kept no record.

    Raises:
        ValueError: a factor is neither NaN nor from 0 to 1.
    """
    factors, path = array("d"), Path(folder) / FILE
    if path.exists():
        data = strange_files.read_bytes(path, MAX_BYTES)
        factors.frombytes(data[: len(data) // factors.itemsize * factors.itemsize])
    if not all(0 <= factor <= 1 or math.isnan(factor) for factor in factors):
        raise ValueError(f"{path} is damaged: factors of the learning rate are from 0 to 1")
    return factors


class AnnealingRecord:
    """Appends to a run's record.

    Args:
        folder: the run folder.
        n_updates: updates of the run so far. Factors of later updates are removed; missing factors
            become NaN.

    Raises:
        OSError: the file cannot be written.
        ValueError: the record is damaged, or `n_updates` is far more than it holds.
    """

    def __init__(self, folder: Path | str, n_updates: int = 0):
        n_kept = min(n_updates, len(read(folder)))
        self.file = AppendedFile(Path(folder) / FILE, n_kept * array("d").itemsize)
        if n_updates - n_kept > MAX_MISSING:
            raise ValueError(f"{folder} has had no {n_updates:,} updates, as its checkpoint says")
        for _ in range(n_kept, n_updates):
            self.append(math.nan)

    def append(self, factor: float) -> None:
        """Appends the factor of an update, in memory until the next `flush`."""
        self.file.unwritten += array("d", [factor]).tobytes()

    def flush(self) -> None:
        """Writes the appended factors."""
        self.file.flush()

    def sync(self) -> None:
        """Writes the appended factors and flushes them to disk."""
        self.file.sync()

    def close(self) -> None:
        """Writes the appended factors, if the disk has room, and closes the file."""
        with contextlib.suppress(OSError):
            self.file.close()
