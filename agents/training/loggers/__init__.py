"""Loggers of a run: JSON lines always, and those that were chosen, each in a file of its own here.

`metrics.jsonl` holds only what the seed determines, so two runs of one configuration write the same
bytes. Rates and times are in `perf.jsonl`. After start-up no failure of a logger stops a run.

A file `mlflow.py` here with a class `MLflow` is `logger=mlflow`. `megastep.agents.types.Logger`
says what it needs.
"""

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

from megastep.agents.errors import UserError, shortened
from megastep.agents.runs.json_lines import JsonLines, truncate_after
from megastep.agents.training.trainer import Trainer
from megastep.agents.types import Logger, RunResult


class Loggers:
    """All loggers of one run. Raises UserError: the files cannot be written. They are unchanged.
    Any logger beside the JSON lines is dropped with a warning when it cannot be made or fails.

    Args:
        folder: the run folder.
        step: environment steps at which a resumed run starts. Later lines are removed.
        others: functions that make loggers beside the JSON lines, by the loggers' names.
    """

    def __init__(
        self,
        folder: Path | str,
        step: int = 0,
        others: Mapping[str, Callable[[], Logger]] | None = None,
    ):
        folder = Path(folder)
        paths = folder / "metrics.jsonl", folder / "perf.jsonl"
        try:
            for path in paths:
                truncate_after(path, step)
            self.metrics, self.perf = (JsonLines(path) for path in paths)
        except OSError as error:
            raise UserError(
                f"The metrics in {folder} cannot be written ({error.strerror}) and are unchanged. "
                "Free some space or get write access, then start again"
            ) from error
        self.others = {}
        for name, make in (others or {}).items():
            try:
                self.others[name] = make()
            except Exception as error:
                warnings.warn(f"logger={name} skipped: {shortened(error, 300)}", stacklevel=2)

    def on_report(self, trainer: Trainer, metrics: Mapping[str, float | str]) -> None:
        """Writes a report."""
        self.write(trainer.samples, metrics)

    def write(self, step: int, metrics: Mapping[str, float | str]) -> None:
        """Writes a report after `step` environment steps; the seed determines all but `perf/`."""
        values = {name: x for name, x in metrics.items() if name != "samples"}
        perf = {name: x for name, x in values.items() if name.startswith("perf/")}
        of_seed = {name: x for name, x in values.items() if name not in perf}
        self.metrics.write(step, of_seed)
        self.perf.write(step, perf)
        self._call_others("write", step, {**of_seed, **perf})

    def may_save(self, trainer: object) -> bool:
        """Flushes the metrics to disk, before a checkpoint. Returns whether they are there."""
        return self.metrics.sync()

    def finish(self, step: int, result: RunResult) -> None:
        """Gives the result of the run to all loggers that have a method `finish`."""
        for name in [name for name in self.others if not hasattr(self.others[name], "finish")]:
            self.others.pop(name).close()
        self._call_others("finish", step, result)

    def close(self) -> None:
        """Closes the files and every logger."""
        self.metrics.close()
        self.perf.close()
        self._call_others("close")

    def _call_others(self, method, *args) -> None:
        for name, logger in list(self.others.items()):
            try:
                getattr(logger, method)(*args)
            except Exception as error:
                del self.others[name]
                text = f"logger={name} failed and is dropped ({shortened(error, 300)})"
                warnings.warn(text, stacklevel=3)
