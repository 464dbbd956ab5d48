"""A profile of a few updates of a run: a trace, and a table of where the time went."""

import contextlib
import os
import warnings
from pathlib import Path

import torch

from megastep.agents import console
from megastep.agents.training.performance import PHASES
from megastep.atomic_files import write_atomically

#: Updates before a profile: the first ones initialise libraries and capture CUDA graphs.
N_SKIPPED = 3
#: Rows in the table of operations, and characters of a name: those of templates have hundreds.
N_ROWS, MAX_NAME = 100, 90


class Profiler:
    """Profiles some updates of a run with `torch.profiler` and writes two files into its folder:
    `profile.json.gz`, a Chrome trace (for https://ui.perfetto.dev), and `profile.txt`, PyTorch's
    table of the phases and operations, on a GPU kernels, that took longest. If it fails, it warns.

    Args:
        folder: the run folder.
        n_updates: number of updates, after the first `N_SKIPPED`.
    """

    def __init__(self, folder: Path, n_updates: int, device: torch.device):
        self.folder, self.n_updates, self.device = folder, n_updates, device
        self.n_begun, self._range, self._profile = 0, contextlib.ExitStack(), None
        os.environ.setdefault("KINETO_LOG_LEVEL", "6")  # it prints a line at each start and stop

    def on_collect(self, trainer: object) -> None:
        """Begins an update, and its first phase."""
        if self.n_begun == N_SKIPPED:
            kinds = torch.profiler.ProfilerActivity
            on_gpu = [kinds.CUDA] if self.device.type == "cuda" else []
            self._profile = torch.profiler.profile(activities=[kinds.CPU, *on_gpu], acc_events=True)
            self._tolerated(self._profile.start)
        if self.n_begun == N_SKIPPED + self.n_updates:
            self.close()
        self.n_begun += 1
        self._begin(PHASES[0])

    def on_rollout(self, trainer: object, rollout: object) -> None:
        """Begins the second phase."""
        self._begin(PHASES[1])

    def on_update(self, trainer: object, losses: object) -> None:
        """Begins the last phase."""
        self._begin(PHASES[2])

    def close(self) -> None:
        """Writes the profile of the updates so far, if that has not been done."""
        self._begin(None)
        if self._profile is not None:
            self._tolerated(self._write)
        self._profile = None

    def _begin(self, phase) -> None:
        self._range.close()
        if self._profile is not None and phase is not None:
            self._range.enter_context(torch.profiler.record_function(phase))

    def _write(self) -> None:
        assert self._profile is not None
        self._profile.stop()
        self._profile.export_chrome_trace(str(self.folder / "profile.json.gz"))
        kind = "cuda" if self.device.type == "cuda" else "cpu"
        table = self._profile.key_averages().table(
            sort_by=f"self_{kind}_time_total", row_limit=N_ROWS, max_name_column_width=MAX_NAME
        )
        head = f"Updates {N_SKIPPED + 1} to {self.n_begun} on {self.device}, together"
        path = self.folder / "profile.txt"
        write_atomically(path, f"{head}:\n{table}".encode())
        console.say(f"Profile: {path}, and a trace beside it")

    def _tolerated(self, call) -> None:
        """Turns an error into a warning, after which nothing is profiled."""
        try:
            call()
        except Exception as error:  # training is worth more
            self._profile = None
            reason = str(error).partition("\n")[0]
            warnings.warn(f"The profile could not be made: {reason}", stacklevel=3)
