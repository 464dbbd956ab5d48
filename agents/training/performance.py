"""Where a run's time and memory go."""

import time
from collections import deque
from collections.abc import Callable
from typing import Any

import torch

#: The phases of an iteration.
PHASES = "collect", "update", "rest"
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
