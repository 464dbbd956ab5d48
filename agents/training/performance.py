"""Where a run's time and memory go."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING, Any

import torch

if TYPE_CHECKING:
    from megastep.agents.training.trainer import Trainer

#: The phases of an iteration.
PHASES = "collect", "update", "rest"
#: Updates that the host may be ahead of a GPU. The learning rate of an update follows the clock at
#: its launch, so a host far ahead would let it fall late, and not to 0. A GPU goes on for so many
#: updates when the host is held up.
MAX_AHEAD = 8


class Timing:
    """Reports rates and times, and keeps the host near a GPU. There CUDA events on the current
    stream divide the phases; other streams count where that one waits for them.

    Attributes:
        times_phases: false for a member of a population but the first, as members share the device.
        rate: samples per second between the last two reports, or None.
    """

    def __init__(self, device: torch.device | str):
        self.device, self.times_phases = torch.device(device), True
        self.rate: float | None = None
        self.samples, self.seconds = 0, 0.0  # at the last report
        self._seconds = {}
        self._starts = deque()  # (phase, its start); the ends of all but the last are starts too

    def start(self, phase: str) -> None:
        """Ends the current phase and starts another, without waiting for a GPU."""
        if self.times_phases:
            self._starts.append((phase, self._now()))
            self._add_finished()

    def wait(self) -> None:
        """Waits until a GPU is at most `MAX_AHEAD` updates behind, beside the current phase."""
        while len(self._starts) > MAX_AHEAD * len(PHASES) + 1:
            time.sleep(0.0005)
            self._add_finished()

    def pop(self) -> dict[str, float]:
        """Returns the seconds of each phase since the last call. Synchronises."""
        if self._starts:
            self.start(self._starts[-1][0])
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
            self._add_finished()
        seconds, self._seconds = self._seconds, {}
        return seconds

    def _now(self) -> Any:  # seconds, on a GPU an event
        if self.device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self.device))
        return event

    def _add_finished(self) -> None:
        while len(self._starts) > 1:
            (phase, start), (_, end) = self._starts[0], self._starts[1]
            if self.device.type != "cuda":
                seconds = end - start
            elif end.query():
                seconds = start.elapsed_time(end) / 1000
            else:
                return
            self._seconds[phase] = self._seconds.get(phase, 0.0) + seconds
            self._starts.popleft()

    def restart(self, trainer: Trainer) -> None:
        """Starts the trainer's clock, and rates with it. Synchronises."""
        self.pop()
        trainer.clock.start()
        self.samples, self.seconds = trainer.samples, trainer.clock.seconds

    def on_report(self, trainer: Trainer, metrics: dict[str, Any]) -> None:
        """Adds times and rates, which leave out the first update: it compiles. Synchronises.

        Metrics:
            perf/rate: samples per second since the last report.
            perf/seconds: seconds of training so far.
            perf/seconds_to_stop: seconds of training at which an evaluation reached `stop`.
            perf/collect: seconds of collecting since the last report, on a GPU of the GPU.
            perf/update: seconds of updates, in the same way.
            perf/rest: seconds of everything else: statistics, logging, checkpoints, evaluations.
            perf/memory_allocated: on a GPU, bytes of tensors.
            perf/memory_reserved: on a GPU, bytes that PyTorch has reserved.
            perf/memory_peak: on a GPU, the most bytes of tensors so far. Of a population, whose
                members share the GPU, the first alone has these three, and the times of phases.
        """
        metrics["perf/seconds"] = seconds = trainer.clock.seconds
        if trainer.samples > self.samples:  # not for the first update, which compiles
            self.rate = (trainer.samples - self.samples) / (seconds - self.seconds)
            metrics["perf/rate"] = self.rate
            phases = self.pop() if self.times_phases else {}
            metrics |= {f"perf/{phase}": of_phase for phase, of_phase in phases.items()}
        if self.times_phases and self.device.type == "cuda":
            stats = torch.cuda.memory_stats(self.device)  # once, as it takes half a millisecond
            keys = dict(allocated="allocated_bytes.all.current")
            keys |= dict(reserved="reserved_bytes.all.current", peak="allocated_bytes.all.peak")
            metrics |= {f"perf/memory_{name}": stats.get(key, 0) for name, key in keys.items()}
        self.samples, self.seconds = trainer.samples, seconds
