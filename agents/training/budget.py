"""When a run ends, how its learning rate is annealed, and the clock for both.

A sample is one environment step of one lane.
"""

import dataclasses
import time


@dataclasses.dataclass(frozen=True)
class Budget:
    """Ends a run after a number of samples or seconds, whichever comes first.

    Args:
        samples: environment steps of all lanes together; None for no limit.
        seconds: seconds of training; None for no limit.
        anneal: "samples" or "seconds": the learning rate falls linearly to 0 over that limit.
            "never": it is constant. Annealing over samples is reproducible, over seconds is not.
    """

    samples: int | None = None
    seconds: float | None = None
    anneal: str = "never"

    @property
    def is_limited(self) -> bool:
        """True if either limit is set."""
        return self.samples is not None or self.seconds is not None

    def fraction_left(self, samples: int, seconds: float) -> float:
        """Returns the fraction of the budget that is left: 1 if there is no limit, below 0 if it is
        overspent.
        """
        return min(_fraction_left(samples, self.samples), _fraction_left(seconds, self.seconds))

    def lr_fraction(self, samples: int, seconds: float) -> float:
        """Returns the factor for the learning rate, from 1 to 0."""
        if self.anneal == "never":
            return 1.0
        if self.anneal == "samples":
            return max(0.0, _fraction_left(samples, self.samples))
        return max(0.0, _fraction_left(seconds, self.seconds))


def _fraction_left(spent, limit):
    return 1.0 if limit is None else 1 - spent / limit


class Stopwatch:
    """Counts seconds of training.

    Attributes:
        seconds_before: seconds that the run had trained before it was resumed.
        started: time of `start` on the monotonic clock, or None.
    """

    def __init__(self):
        self.seconds_before = 0.0
        self.started = None

    def start(self) -> None:
        """Starts counting. Called after the first update, so compilation does not count."""
        self.started = time.monotonic()

    @property
    def is_running(self) -> bool:
        return self.started is not None

    @property
    def seconds(self) -> float:
        """Seconds of training so far, those before a resume included."""
        since_start = time.monotonic() - self.started if self.is_running else 0.0
        return self.seconds_before + since_start
