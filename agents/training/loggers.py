"""Loggers of a run: JSON lines and TensorBoard always, Weights & Biases on request.

`metrics.jsonl` holds only what the seed determines, so two runs of one configuration write the same
bytes. Rates and times are in `perf.jsonl`. After start-up no failure of a logger stops a run.
"""

import importlib.util
import os
import queue
import threading
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

from megastep.agents.runs.atomic_files import write_atomically
from megastep.agents.runs.json_lines import JsonLines, truncate_after
from megastep.agents.training.optional_packages import not_installed

#: Seconds that Weights & Biases may take to start before the run goes on without it.
WANDB_TIMEOUT = 20


class LoggerError(RuntimeError):
    """The metrics of a run cannot be written. The message names the cure."""


class TensorBoard:
    """Writes TensorBoard event files.

    A thread writes, and imports what it needs at the first report: training waits for neither.

    Args:
        folder: where the event files go.
        step: environment steps at which a resumed run starts; later events are discarded.

    Raises:
        RuntimeError: tensorboard is not installed. An error of the thread is raised by the next
            `write` or `close`.
    """

    def __init__(self, folder: Path, step: int):
        if importlib.util.find_spec("tensorboard") is None:
            raise RuntimeError(not_installed("tensorboard"))
        self.folder, self.step, self.error = folder, step, None
        self.thread, self.reports = (
            threading.Thread(target=self._write_reports, daemon=True),
            queue.SimpleQueue(),
        )

    def _write_reports(self):
        try:
            from torch.utils.tensorboard import SummaryWriter

            with SummaryWriter(str(self.folder), purge_step=self.step or None) as writer:
                while report := self.reports.get():
                    step, values = report
                    for name, value in values.items():
                        if not isinstance(value, str):
                            writer.add_scalar(name, value, step)
        except Exception as error:
            self.error = error

    def write(self, step: int, values: dict[str, float | str]) -> None:
        if self.error:
            raise self.error
        if not self.thread.ident:
            self.thread.start()
        self.reports.put((step, values))

    def close(self) -> None:
        self.reports.put(None)
        if self.thread.ident:
            self.thread.join()
        if self.error:
            raise self.error


class Wandb:
    """Logs to Weights & Biases, online or offline. Never asks for a key on the terminal.

    The run's id is stored in its folder, so a resumed run continues the same Weights & Biases run.

    Args:
        folder: the run folder.
        project, mode, name, config, group: as `wandb.init` takes them.

    Raises:
        RuntimeError: wandb is not installed, has no key, or did not start.
    """

    def __init__(
        self,
        folder: Path,
        project: str,
        mode: str,
        name: str,
        config: dict[str, Any],
        group: str | None = None,
    ):
        os.environ.setdefault("WANDB_SILENT", "true")
        try:
            wandb = importlib.import_module("wandb")
        except ImportError:
            raise RuntimeError(not_installed("wandb")) from None
        if mode == "online" and not self._has_key(wandb):
            raise RuntimeError(
                "Weights & Biases skipped: it has no key here. Run `wandb login`, or use "
                "logger.mode=offline, which needs none"
            )
        id_file = folder / "wandb-id.txt"
        try:
            self.run = wandb.init(
                project=project,
                mode=mode,
                name=name,
                group=group,
                config=config,
                dir=str(folder),
                id=id_file.read_text() if id_file.exists() else None,
                resume="allow",
                settings=wandb.Settings(init_timeout=WANDB_TIMEOUT, silent=True, console="off"),
            )
            write_atomically(id_file, self.run.id.encode())
        except Exception as error:  # wandb raises its own errors, the network's and the system's
            raise RuntimeError(
                f"Weights & Biases skipped: it did not start ({_first_line(error)})"
            ) from None

    @staticmethod
    def _has_key(wandb: ModuleType) -> bool:
        """Returns True if a key is in the environment or a file. Does not prompt for one."""
        try:
            return bool(os.environ.get("WANDB_API_KEY") or wandb.login(prompt=False))
        except TypeError:  # older versions of wandb have no such argument
            return bool(wandb.api.api_key)

    def write(self, step: int, values: dict[str, float | str]) -> None:
        self.run.log({"samples": step, **values}, step=step)

    def close(self) -> None:
        self.run.finish()


class Loggers:
    """All loggers of one run.

    A file that cannot be written is warned about once, and the next report tries again. TensorBoard
    or Weights & Biases is dropped with a warning when it fails.

    Args:
        folder: the run folder.
        step: environment steps at which a resumed run starts. Later lines are removed.
        wandb: arguments of `Wandb` without the folder, or None to do without.

    Raises:
        LoggerError: the files cannot be written. They are unchanged.
    """

    def __init__(self, folder: Path | str, step: int = 0, wandb: dict[str, Any] | None = None):
        folder = Path(folder)
        paths = folder / "metrics.jsonl", folder / "perf.jsonl"
        try:
            for path in paths:
                truncate_after(path, step)
            self.metrics, self.perf = (JsonLines(path) for path in paths)
        except OSError as error:
            raise LoggerError(
                f"The metrics in {folder} cannot be written ({error.strerror}) and are unchanged. "
                "Free some space or get write access, then start again"
            ) from error
        self.optional = []
        self._add_optional(TensorBoard, folder / "tensorboard", step)
        if wandb is not None:
            self._add_optional(Wandb, folder, **wandb)

    def _add_optional(self, logger_class, *args, **kwargs):
        try:
            self.optional.append(logger_class(*args, **kwargs))
        except Exception as error:
            warnings.warn(_first_line(error), stacklevel=3)

    def write(
        self, step: int, metrics: dict[str, float | str] | None, perf: dict[str, float]
    ) -> None:
        """Writes one report after `step` environment steps.

        Args:
            metrics: name -> number or string, determined by the seed. None: only `perf` is written.
            perf: name -> number, such as times and rates.
        """
        if metrics is not None:
            self._call(self.metrics, "write", step, metrics)
        self._call(self.perf, "write", step, perf)
        for logger in list(self.optional):
            self._call(logger, "write", step, {**(metrics or {}), **perf})

    def sync(self) -> None:
        """Flushes the metrics to disk. Raises OSError if they cannot be written."""
        self.metrics.file.sync()

    def close(self) -> None:
        for logger in [self.metrics, self.perf, *self.optional]:
            self._call(logger, "close")

    def _call(self, logger, method, *args):
        """Calls a logger's method; turns an exception into a warning."""
        try:
            getattr(logger, method)(*args)
        except Exception as error:
            name = getattr(logger, "path", None) or type(logger).__name__
            if logger in self.optional:
                self.optional.remove(logger)
                warnings.warn(f"{name} failed and is dropped ({_first_line(error)})", stacklevel=3)
            elif not getattr(logger, "has_warned", False):
                logger.has_warned = True
                warnings.warn(
                    f"{name} cannot be written ({_first_line(error)}); the run goes on",
                    stacklevel=3,
                )


class NoLogger:
    """Writes nothing, as on ranks other than 0."""

    def write(
        self, step: int, metrics: dict[str, float | str] | None, perf: dict[str, float]
    ) -> None:
        pass

    def sync(self) -> None:
        pass

    def close(self) -> None:
        pass


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
