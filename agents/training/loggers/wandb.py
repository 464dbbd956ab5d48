"""Weights & Biases, an optional package."""

import importlib
import os
from pathlib import Path
from types import ModuleType
from typing import Literal

from megastep.agents import package
from megastep.agents.errors import shortened
from megastep.agents.runs import provenance
from megastep.agents.types import RunResult
from megastep.atomic_files import write_atomically

#: Seconds that Weights & Biases may take to start before the run goes on without it.
TIMEOUT = 20


class Wandb:
    """Logs to Weights & Biases, online or offline. Never asks for a key on the terminal. Raises
    RuntimeError: wandb is not installed, has no key, or did not start.

    The run's id is stored in its folder, so a resumed run continues the same Weights & Biases run.
    Its configuration has the settings and the commit of megastep, its summary the final numbers.

    Args:
        folder: the run folder.
        run_name: name of the run on Weights & Biases.
        config: settings of the run.
        project: project on Weights & Biases.
        mode: `offline` needs no key and keeps the run in its folder until `wandb sync`.
        group: group of the run; a sweep sets it to the name of its folder, unless one is given.
    """

    def __init__(
        self,
        folder: Path,
        run_name: str,
        config: dict,
        project: str = "megastep",
        mode: Literal["online", "offline"] = "online",
        group: str | None = None,
    ):
        os.environ.setdefault("WANDB_SILENT", "true")
        try:
            wandb = importlib.import_module("wandb")
        except ImportError:
            raise RuntimeError("wandb is not installed; pip install wandb") from None
        if mode == "online" and not self._has_key(wandb):
            raise RuntimeError(
                "it has no key here. Run `wandb login`, or use "
                "logger.wandb.mode=offline, which needs none"
            )
        id_file = folder / "wandb-id.txt"
        self.wandb = wandb
        try:
            self.run = wandb.init(
                project=project,
                mode=mode,
                name=run_name,
                group=group,
                job_type="train",
                config={"commit": provenance.commit(package.ROOT), **config},
                dir=str(folder),
                id=id_file.read_text() if id_file.exists() else None,
                resume="allow",
                settings=wandb.Settings(init_timeout=TIMEOUT, silent=True, console="off"),
            )
            write_atomically(id_file, self.run.id.encode())
        except Exception as error:  # wandb raises its own errors, the network's and the system's
            raise RuntimeError(f"it did not start ({shortened(error, 300)})") from None

    @staticmethod
    def _has_key(wandb: ModuleType) -> bool:
        """Returns True if a key is in the environment or a file. Does not prompt for one."""
        try:
            return bool(os.environ.get("WANDB_API_KEY") or wandb.login(prompt=False))
        except TypeError:  # older versions of wandb have no such argument
            return bool(wandb.api.api_key)

    def write(self, step: int, values: dict[str, float | str]) -> None:
        """Logs one report."""
        self.run.log({"samples": step, **values}, step=step)

    def finish(self, step: int, result: RunResult) -> None:
        """Logs the final numbers as the run's summary, the film, and the evaluation as a table."""
        self.run.summary.update({f"final/{name}": x for name, x in result.numbers.items()})
        shown = {}
        if result.film is not None:
            ending = result.film.suffix[1:]
            shown["film"] = self.wandb.Video(str(result.film), format=ending)
        if result.table:
            rows = [[*row.values()] for row in result.table]
            shown["evaluation"] = self.wandb.Table(columns=[*result.table[0]], data=rows)
        if shown:
            self.run.log({"samples": step, **shown}, step=step)

    def close(self) -> None:
        """Ends the run on Weights & Biases."""
        self.run.finish()
