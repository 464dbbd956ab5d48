"""Where a run's time and memory go."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch

from megastep.agents.distributed.process_group import counts, waiting

if TYPE_CHECKING:
    from megastep.agents.training.trainer import Trainer

#: The phases of an iteration.
PHASES = "collect", "update", "rest"
#: Updates that the host may be ahead of a GPU. The learning rate of an update follows the clock at
#: its launch, so a host far ahead would let it fall late, and not to 0. A GPU goes on for so many
#: updates when the host is held up.
MAX_AHEAD = 8
#: Seconds after which the host no longer waits for a GPU, which itself may wait for a lost rank.
#: By then the watch has ended the ranks, if there are several.
PATIENCE = 90.0


class PhaseTimer:
    """Adds up the seconds that a loop spends in each of its phases. Only `pop` and `wait` wait for
    a GPU.

        timer.start("collect")
        rollout = collect()
        timer.start("update")
        learner.update(rollout)
        timer.start("rest")

    On a GPU, a phase lasts from the time its first kernel can start to that of the next phase on
    the current stream, by CUDA events. Work on other streams counts only where that stream waits
    for it.

    Args:
        device: where the loop's work is done.
        on_finished: called whenever a phase has ended.
    """

    def __init__(self, device: torch.device | str, on_finished: Callable[[], None] = lambda: None):
        self.device, self.on_finished = torch.device(device), on_finished
        self._seconds = {}
        self._starts = deque()  # (phase, its start); the ends of all but the last are starts too

    def start(self, phase: str) -> None:
        """Ends the current phase and starts another."""
        self._starts.append((phase, self._now()))
        self._add_finished()

    def wait(self, n_phases: int) -> None:
        """Waits until a GPU is at most so many phases behind the host, not counting the current
        phase, or `PATIENCE` is over.
        """
        deadline = time.monotonic() + PATIENCE
        while len(self._starts) > n_phases + 1 and time.monotonic() < deadline:
            time.sleep(0.0005)
            self._add_finished()

    def pop(self) -> dict[str, float]:
        """Returns the seconds of each phase since the last call. The current phase goes on.

        Synchronises.
        """
        if self._starts:
            self.start(self._starts[-1][0])
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
            self._add_finished()
        seconds, self._seconds = self._seconds, {}
        return seconds

    def _now(self) -> Any:
        """Returns this moment: seconds, on a GPU an event."""
        if self.device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self.device))
        return event

    def _add_finished(self) -> None:
        """Adds the phases that have ended, so that no more events are kept than the GPU is behind.

        Does not wait for a GPU.
        """
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
            self.on_finished()


class Timing:
    """Reports rates and times, and keeps the host near a GPU.

    Args:
        device: where the training is done.

    Attributes:
        timer: of the phases; None for a member of a population but the first, as members share
            the device.
        rate: samples per second between the last two reports, or None.
    """

    def __init__(self, device: torch.device | str):
        self.timer: PhaseTimer | None = PhaseTimer(device, counts.finish_phase)
        self.rate: float | None = None
        self.samples, self.seconds = 0, 0.0  # at the last report

    def on_collect(self, trainer: Trainer) -> None:
        """Begins the first of the `PHASES`."""
        self._start("collect")

    def on_rollout(self, trainer: Trainer, rollout: object) -> None:
        """Begins the second."""
        self._start("update")

    def on_update(self, trainer: Trainer, losses: object) -> None:
        """Begins the last."""
        self._start("rest")

    def _start(self, phase) -> None:
        if self.timer is not None:
            self.timer.start(phase)

    def wait(self) -> None:
        """Waits until a GPU is at most `MAX_AHEAD` updates behind."""
        if self.timer is not None:
            with waiting():
                self.timer.wait(MAX_AHEAD * len(PHASES))

    def restart(self, trainer: Trainer) -> None:
        """Starts the trainer's clock, and rates with it. Synchronises."""
        if torch.device(trainer.env.device).type == "cuda":
            torch.cuda.synchronize(trainer.env.device)
        trainer.clock.start()
        self.samples, self.seconds = trainer.samples, trainer.clock.seconds
        if self.timer is not None:
            self.timer.pop()

    def on_report(self, trainer: Trainer, metrics: dict[str, Any]) -> None:
        """Adds times and rates, which leave out the first update: it compiles. Synchronises.

        Metrics:
            perf/rate: samples per second since the last report.
            perf/seconds: seconds of training so far.
            perf/seconds_to_stop: seconds of training at which an evaluation reached `stop`.
            perf/collect: seconds of collecting since the last report, on a GPU of the GPU; with
                `learner.lag`, as far as the learner waits for it.
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
            phases = {} if self.timer is None else self.timer.pop()
            metrics |= {f"perf/{phase}": of_phase for phase, of_phase in phases.items()}
        memory = {} if self.timer is None else device_memory(self.timer.device)
        metrics |= {f"perf/memory_{name}": n for name, n in memory.items()}
        self.samples, self.seconds = trainer.samples, seconds


def device_memory(device: torch.device | str) -> dict[str, int]:
    """Returns bytes of a GPU's memory by name, empty for a CPU. Does not synchronise.

    `allocated` by tensors now, `reserved` by PyTorch for them, and the `peak` of the former since
    the process started.
    """
    if torch.device(device).type != "cuda":
        return {}
    stats = torch.cuda.memory_stats(device)  # once, as each call takes half a millisecond
    keys = dict(allocated="allocated_bytes.all.current", reserved="reserved_bytes.all.current")
    keys["peak"] = "allocated_bytes.all.peak"
    return {name: stats.get(key, 0) for name, key in keys.items()}
