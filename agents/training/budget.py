"""When a run ends, how its learning rate falls, and the clock that both may follow.

"Samples" are environment steps of all lanes together.
"""

import dataclasses
import time


@dataclasses.dataclass(frozen=True)
class Budget:
    """A run ends after so many samples or so many seconds of training, whichever comes first; with
    neither, never.

    `anneal` names what the learning rate falls to 0 over: "samples", "seconds" or "never". What
    follows samples is the same in every run of a seed; what follows the clock is not.
    """

    samples: int | None = None
    seconds: float | None = None
    anneal: str = "never"

    @property
    def is_limited(self) -> bool:
        """Whether the run ends by itself."""
        return self.samples is not None or self.seconds is not None

    def left(self, samples: int, seconds: float) -> float:
        """The fraction of the budget that is left; without one, all of it."""
        return min(_left(samples, self.samples), _left(seconds, self.seconds))

    def lr_fraction(self, samples: int, seconds: float) -> float:
        """What to multiply the learning rate by."""
        if self.anneal == "never":
            return 1.0
        follows_samples = self.anneal == "samples"
        return max(
            0.0,
            _left(samples, self.samples) if follows_samples else _left(seconds, self.seconds),
        )


def _left(spent, limit):
    return 1.0 if limit is None else 1 - spent / limit


class Stopwatch:
    """Seconds of training: those `before` a resume, and those since `start`."""

    def __init__(self):
        self.before = 0.0
        self.started = None

    def start(self) -> None:
        """Called at the end of the first update, so that compiling does not count."""
        self.started = time.monotonic()

    @property
    def is_running(self) -> bool:
        return self.started is not None

    @property
    def seconds(self) -> float:
        return self.before + (time.monotonic() - self.started if self.is_running else 0.0)
