"""Where a run's time and memory go."""

import time
from collections import Counter, deque
from collections.abc import Callable

import torch

from megastep.agents import sections

#: The sections of an iteration. "log" is all between two iterations: statistics, reports,
#: checkpoints, snapshots.
SECTIONS = "act", "env", "store", "returns", "forward", "backward", "optimiser", "log"
#: The phases of an iteration.
PHASES = "collect", "update", "rest"
#: Seconds after which the host no longer waits for a GPU: another rank may be lost, which the host
#: notices when it speaks to the others.
PATIENCE = 5.0
#: Iterations before sections are measured on a GPU, so that clocks and caches are as in training,
#: and after: the last one counts.
N_WARM_UPS, N_REPLAYS = 3, 4


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
    """

    def __init__(self, device: torch.device | str):
        self.device = torch.device(device)
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

    def _now(self):
        """Returns this moment: seconds, on a GPU an event."""
        if self.device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self.device))
        return event

    def _add_finished(self):
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


class SectionTimes:
    """Where the iterations of a run spend their time, in milliseconds.

    On a CPU sections always add up. On a GPU they are unknown until `measure`, but for "log".

    Args:
        device: where the iterations are done.

    Attributes:
        iteration: an iteration of the run so far, in milliseconds; 0 before the first `add`.
    """

    def __init__(self, device: torch.device | str):
        self.on_gpu = torch.device(device).type == "cuda"
        self.n, self.seconds, self.total, self.measured = 0, Counter(), 0.0, {}

    @property
    def is_known(self) -> bool:
        """Whether there is more to say than what "log" takes."""
        return self.n > 0 and not (self.on_gpu and not self.measured)

    @property
    def iteration(self) -> float:
        return 1000 * self.total / max(1, self.n)

    def add(self, phases: dict[str, float], n: int) -> dict[str, float]:
        """Adds `n` iterations. Returns the milliseconds of one of them by section.

        Args:
            phases: seconds of each phase of a `PhaseTimer`.
        """
        seconds = {} if self.on_gpu else sections.pop()
        seconds["log"] = phases.get("rest", 0.0)
        self.n, self.total = self.n + n, self.total + sum(phases.values())
        self.seconds.update(seconds)
        return _milliseconds(seconds, n)

    def measure(self, collect: Callable[[], object], update: Callable[[], object]) -> None:
        """Measures the sections of a GPU. The functions capture CUDA graphs in their next call."""
        with sections.Spans() as collecting:
            collect()
        with sections.Spans() as updating:
            update()
        for _ in range(N_REPLAYS):
            collect()
            update()
        seconds = Counter(collecting.seconds())
        seconds.update(updating.seconds())
        self.measured = _milliseconds(seconds, 1)

    def milliseconds(self) -> dict[str, float]:
        """Returns the milliseconds of an iteration of the run by section, in order."""
        return self.measured | _milliseconds(self.seconds, max(1, self.n))


def _milliseconds(seconds, n):
    return {name: 1000 * seconds[name] / n for name in SECTIONS if name in seconds}


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
