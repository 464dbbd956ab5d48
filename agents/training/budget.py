"""When a run ends, how its learning rate is annealed, and the clock for both.

A sample is one environment step of one lane.
"""

import contextlib
import dataclasses
import math
import time
from array import array
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from megastep.agents.runs.json_lines import AppendedFile

#: The learning rate's factor (1 at first) in each update of a run, as one float64. With `seconds=`
#: factors depend on the clock; by this file `rerun` repeats such a run.
RECORD = "annealing.f64"


@dataclasses.dataclass(frozen=True)
class Budget:
    """Ends a run after a number of samples or seconds, whichever comes first.

    Args:
        samples, seconds: None for no limit.
        anneal: "samples" or "seconds": the learning rate falls linearly to 0 over that limit.
            "never": it is constant.
        recorded: the factors of the learning rate in the first updates, as an earlier run of the
            same configuration recorded them (`annealing`). They replace the clock's.
        is_rerun: the run ends after the updates that are recorded.
    """

    samples: int | None = None
    seconds: float | None = None
    anneal: str = "never"
    recorded: Sequence[float] = ()
    is_rerun: bool = False

    @property
    def is_limited(self) -> bool:
        """Whether the run ends by itself."""
        return self.is_rerun or self.samples is not None or self.seconds is not None

    def fraction_left(self, updates: int, samples: int, seconds: float) -> float:
        """Returns the fraction that is left: 1 without a limit, below 0 if it is overspent."""
        if self.is_rerun:
            return _fraction_left(updates, len(self.recorded))
        seconds_left = _fraction_left(seconds, self.seconds)
        if updates < len(self.recorded):  # which the clock once left time for
            seconds_left = max(seconds_left, 1e-9)
        return min(_fraction_left(samples, self.samples), seconds_left)

    def lr_fraction(self, updates: int, samples: int, seconds: float) -> float:
        """Returns the fraction of the budget that is left for the next update, from 1 to 0."""
        if updates < len(self.recorded):
            return self.recorded[updates]
        if self.anneal == "samples" or (self.anneal == "never" and self.samples is not None):
            return max(0.0, _fraction_left(samples, self.samples))
        return max(0.0, _fraction_left(seconds, self.seconds))


def _fraction_left(spent, limit) -> float:
    return 1.0 if limit is None else 1 - spent / limit


def evaluation_in(state: Mapping) -> dict[str, float]:
    """Returns the last evaluation in the state of a run, or in its numbers."""
    return {name[5:]: float(x) for name, x in state.items() if name.startswith("eval/")}


def reaches(evaluation: Mapping[str, float], stop: Mapping[str, float]) -> bool:
    """Returns whether an evaluation has at least all numbers of `stop`, if there are any."""
    least = -math.inf
    return bool(stop) and all(evaluation.get(name, least) >= x for name, x in stop.items())


class Stopwatch:
    """Counts seconds of training, from `start` on: after the first update, which compiles."""

    seconds_before = 0.0  # that the run had trained before it was resumed
    started: float | None = None

    def start(self) -> None:
        """Starts counting."""
        self.started = time.monotonic()

    @contextlib.contextmanager
    def paused(self) -> Iterator[None]:
        """What is done inside does not count."""
        began = time.monotonic()
        try:
            yield
        finally:
            if self.started is not None:
                self.started += time.monotonic() - began

    @property
    def is_running(self) -> bool:
        """Whether the time counts."""
        return self.started is not None

    @property
    def seconds(self) -> float:
        """Seconds of training so far, those before a resume included."""
        since_start = 0.0 if self.started is None else time.monotonic() - self.started
        return self.seconds_before + since_start


def read_record(folder: Path | str) -> array:
    """Returns the factor of each update of a run, if it has a record. ValueError if damaged."""
    factors, path = array("d"), Path(folder) / RECORD
    if path.exists():
        data = path.read_bytes()
        factors.frombytes(data[: len(data) // factors.itemsize * factors.itemsize])
    if not all(0 <= factor <= 1 for factor in factors):
        raise ValueError(f"{path} is damaged: factors of the learning rate are from 0 to 1")
    return factors


class AnnealingRecord:
    """A callback that appends to a run's record, whose factors after `n_updates` are removed."""

    def __init__(self, folder: Path | str, n_updates: int = 0):
        n_updates = min(n_updates, len(read_record(folder))) if n_updates else 0
        n_bytes = n_updates * array("d").itemsize
        self.file = AppendedFile(Path(folder) / RECORD, n_bytes)

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
