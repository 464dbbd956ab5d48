"""A profile of a few updates of a run: a trace, and a table of where the time went."""

import contextlib
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

import torch

from megastep.agents import console
from megastep.agents.training.performance import PHASES, PhaseTimer
from megastep.atomic_files import write_atomically

#: Updates before a profile: the first ones initialise libraries and capture CUDA graphs.
N_SKIPPED = 3
#: Rows in the table of operations, and characters of a name: those of templates have hundreds.
N_ROWS, MAX_NAME = 30, 90


class Profiler:
    """Profiles some updates of a run with `torch.profiler` and writes two files into its folder:
    `profile.json.gz`, a Chrome trace (for https://ui.perfetto.dev), and `profile.md`, tables of the
    phases and of the operations that took longest. On a GPU these are its kernels, those in CUDA
    graphs included.

    A profile that cannot be made causes a warning and no error.

    Args:
        folder: the run folder.
        n_updates: number of updates, after the first `N_SKIPPED`.
        device: where the work is done.

    Attributes:
        path: the table, once it is written.
    """

    def __init__(self, folder: Path, n_updates: int, device: torch.device):
        self.folder, self.n_updates, self.device = folder, n_updates, device
        self.path, self.n_begun = None, 0
        self._profile, self._timer, self._range = None, PhaseTimer(device), None

    is_slow = True

    def on_collect(self, trainer: object) -> None:
        """Begins an update, and its first phase."""
        self.start(PHASES[0])

    def on_rollout(self, trainer: object, rollout: object) -> None:
        """Begins the second phase."""
        self.start(PHASES[1])

    def on_update(self, trainer: object, losses: object) -> None:
        """Begins the last phase."""
        self.start(PHASES[2])

    def close(self) -> None:
        """Writes the profile, and says where it is."""
        self.finish()
        if self.path is not None:
            console.say(f"Profile: {self.path}, and a trace beside it")

    def start(self, phase: str) -> None:
        """Ends the current phase and starts another. An update begins with the first phase."""
        with self._tolerating():
            self._close_range()
            if phase == PHASES[0]:
                if self.n_begun == N_SKIPPED:
                    self._begin()
                elif self.n_begun == N_SKIPPED + self.n_updates:
                    self.finish()
                self.n_begun += 1
            if self._profile is not None:
                self._timer.start(phase)
                self._range = torch.profiler.record_function(phase)
                self._range.__enter__()

    def finish(self) -> None:
        """Writes the profile of the updates so far, if any are profiled and not written."""
        with self._tolerating():
            self._close_range()
            if self._profile is None:
                return
            seconds = self._timer.pop()
            profile, self._profile = self._profile, None
            profile.stop()
            profile.export_chrome_trace(str(self.folder / "profile.json.gz"))
            path = self.folder / "profile.md"
            write_atomically(path, self._tables(profile, seconds).encode())
            self.path = path

    def _begin(self) -> None:
        activities, is_gpu = [torch.profiler.ProfilerActivity.CPU], self.device.type == "cuda"
        if is_gpu:
            activities.append(torch.profiler.ProfilerActivity.CUDA)
            torch.cuda.synchronize(self.device)  # what was launched before is not part of it
        os.environ.setdefault("KINETO_LOG_LEVEL", "6")  # it prints a line at each start and stop
        profile = torch.profiler.profile(activities=activities, acc_events=True)
        profile.start()  # takes seconds on a GPU
        self._profile = profile

    def _close_range(self) -> None:
        if self._range is not None:
            self._range.__exit__(None, None, None)
            self._range = None

    @contextlib.contextmanager
    def _tolerating(self) -> Iterator[None]:
        """Turns an error into a warning, after which nothing is profiled."""
        try:
            yield
        except Exception as error:  # training is worth more
            self._profile = self._range = None
            self.n_begun = N_SKIPPED + self.n_updates + 1
            reason = str(error).partition("\n")[0]
            warnings.warn(f"The profile could not be made: {reason}", stacklevel=3)

    def _tables(self, profile, seconds) -> str:
        """Returns Markdown: milliseconds of an update by phase and by operation."""
        n, is_gpu = self.n_begun - N_SKIPPED, self.device.type == "cuda"
        device_types = torch.autograd.DeviceType  # pyright: ignore[reportPrivateImportUsage]
        of_device = device_types.CUDA if is_gpu else device_types.CPU
        times = {}  # name -> calls, microseconds without those of what it calls
        for event in profile.key_averages():
            if event.device_type == of_device and not (is_gpu and event.key in PHASES):
                time = event.self_device_time_total if is_gpu else event.self_cpu_time_total
                name = f"{event.key}, outside of PyTorch" if event.key in PHASES else event.key
                times[name] = event.count, time
        if not times:
            raise RuntimeError("PyTorch's profiler saw no kernels")
        update = 1000 * sum(seconds.values()) / n

        def cells(milliseconds) -> tuple[str, str]:
            return f"{milliseconds:.3g}", f"{100 * milliseconds / update:.1f} %"

        phases = [(phase, *cells(1000 * seconds.get(phase, 0.0) / n)) for phase in PHASES]
        operations = [
            (name[:MAX_NAME], f"{n_calls / n:.3g}", *cells(time / 1000 / n))
            for name, (n_calls, time) in sorted(times.items(), key=lambda item: -item[1][1])
        ]
        texts = (
            f"Updates {N_SKIPPED + 1} to {N_SKIPPED + n} on {self.device}: {update:.3g} ms each, "
            "profiling included. All numbers are of one update.",
            console.table(("phase", "ms", "share"), phases, is_markdown=True),
            console.table(
                ("kernel" if is_gpu else "operation", "calls", "ms", "share"),
                operations[:N_ROWS],
                is_markdown=True,
            ),
        )
        return "\n\n".join(texts) + "\n"
