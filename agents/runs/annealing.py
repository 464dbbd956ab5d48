"""The annealing record: the learning rate's factor (1 at first) in each update, as one float64.

With `seconds=` the factors depend on the clock; the record lets `megastep rerun` repeat such a run.
"""

import contextlib
from array import array
from pathlib import Path
from typing import Any

from megastep.atomic_files import AppendedFile

FILE = "annealing.f64"


def read(folder: Path | str) -> array:
    """Returns the factor of each update of a run; empty without a record. Raises ValueError if one
    is not from 0 to 1.
    """
    factors, path = array("d"), Path(folder) / FILE
    if path.exists():
        data = path.read_bytes()
        factors.frombytes(data[: len(data) // factors.itemsize * factors.itemsize])
    if not all(0 <= factor <= 1 for factor in factors):
        raise ValueError(f"{path} is damaged: factors of the learning rate are from 0 to 1")
    return factors


class AnnealingRecord:
    """A callback that appends to a run's record, whose factors after `n_updates` are removed. What
    a full disk refuses is written later.
    """

    def __init__(self, folder: Path | str, n_updates: int = 0):
        n_bytes = min(n_updates, len(read(folder))) * array("d").itemsize
        self.file = AppendedFile(Path(folder) / FILE, n_bytes)

    def on_rollout(self, trainer: Any, rollout: object) -> None:
        """Appends the factor of the update that a trainer begins, in memory."""
        self.file.unwritten += array("d", [trainer.lr_fraction]).tobytes()

    def on_report(self, trainer: object, metrics: object) -> None:
        """Writes the appended factors."""
        with contextlib.suppress(OSError):
            self.file.flush()

    def may_save(self, trainer: object) -> bool:
        """Flushes the factors to disk, which a checkpoint must not reach beyond."""
        with contextlib.suppress(OSError):
            self.file.sync()
            return True
        return False

    def close(self) -> None:
        """Writes the appended factors and closes the file."""
        with contextlib.suppress(OSError):
            self.file.close()
