"""Where the numbers of a run go: JSON lines and TensorBoard always, Weights & Biases if asked,
curves at the end.

`metrics.jsonl` holds what the seed determines, so two runs of one configuration write the same
bytes; rates and times are in `perf.jsonl`. A sink that fails is dropped with one warning; once it
is open, nothing here can stop a run.
"""

import importlib
import os
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

from megastep.agents.training import atomic_files
from megastep.agents.training.json_lines import JsonLines, read, rewind

#: How each optional part is called, and what installs it.
FEATURES = {
    "tensorboard": "TensorBoard events",
    "wandb": "Weights & Biases",
    "matplotlib": "curves.png",
    "av": "video.mp4",
}
#: Seconds that Weights & Biases may take to start before the run goes on without it.
WANDB_TIMEOUT = 20


class LoggerError(RuntimeError):
    """The files of a run's metrics cannot be used; the message is one sentence with the cure."""


def missing(package: str) -> str:
    """The sentence for a package that is not installed."""
    return (
        f"{FEATURES[package]} left out: the package {package} is not installed; pip install "
        f"{package}"
    )


class TensorBoard:
    """Event files, from `step` environment steps on."""

    def __init__(self, folder: Path, step: int):
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise RuntimeError(missing("tensorboard")) from None
        self.writer = SummaryWriter(str(folder), purge_step=step or None)

    def write(self, step, values):
        for name, value in values.items():
            if not isinstance(value, str):
                self.writer.add_scalar(name, value, step)

    def close(self):
        self.writer.close()


class Wandb:
    """Weights & Biases, online or offline; it never asks for a key at the terminal. The run's id is
    kept in its folder, so that a resumed run goes on as the same run there.
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
            raise RuntimeError(missing("wandb")) from None
        if mode == "online" and not self._has_key(wandb):
            raise RuntimeError(
                "Weights & Biases left out: it has no key here; `wandb login` stores one, "
                "logger.mode=offline needs none"
            )
        known = folder / "wandb-id.txt"
        try:
            self.run = wandb.init(
                project=project,
                mode=mode,
                name=name,
                group=group,
                config=config,
                dir=str(folder),
                id=known.read_text() if known.exists() else None,
                resume="allow",
                settings=wandb.Settings(init_timeout=WANDB_TIMEOUT, silent=True, console="off"),
            )
            atomic_files.replace(known, self.run.id.encode())
        except Exception as error:  # the package raises its own, the network's and the system's
            raise RuntimeError(
                f"Weights & Biases left out: it did not start ({_first_line(error)})"
            ) from None

    @staticmethod
    def _has_key(wandb: ModuleType) -> bool:
        """Whether there is a key, in the environment or a file, without asking for one at the
        terminal.
        """
        try:
            return bool(os.environ.get("WANDB_API_KEY") or wandb.login(prompt=False))
        except TypeError:  # older versions have no such argument
            return bool(wandb.api.api_key)

    def write(self, step, values):
        self.run.log({"samples": step, **values}, step=step)

    def close(self):
        self.run.finish()


class Loggers:
    """All sinks of one run folder. `step`: where a resumed run goes on; `wandb`: arguments of
    `Wandb`, or None. LoggerError if the files cannot be written; they are as they were then.
    """

    def __init__(self, folder: Path | str, step: int = 0, wandb: dict[str, Any] | None = None):
        folder = Path(folder)
        paths = folder / "metrics.jsonl", folder / "perf.jsonl"
        try:
            for path in paths:
                rewind(path, step)
            self.metrics, self.perf = (JsonLines(path) for path in paths)
        except OSError as error:
            raise LoggerError(
                f"The metrics in {folder} cannot be written ({error.strerror}) and are as they "
                "were; make room there, then start again"
            ) from error
        self.others = []
        self._open(TensorBoard, folder / "tensorboard", step)
        if wandb is not None:
            self._open(Wandb, folder, **wandb)

    def _open(self, sink, *arguments, **options):
        try:
            self.others.append(sink(*arguments, **options))
        except Exception as error:
            warnings.warn(_first_line(error), stacklevel=3)

    def write(self, step: int, metrics: dict[str, float | str], perf: dict[str, float]) -> None:
        """Writes one report, both dicts of name -> number or word, after `step` environment
        steps.
        """
        self._guarded(self.metrics, "write", step, metrics)
        self._guarded(self.perf, "write", step, perf)
        for sink in list(self.others):
            self._guarded(sink, "write", step, {**metrics, **perf})

    def close(self) -> None:
        for sink in [self.metrics, self.perf, *self.others]:
            self._guarded(sink, "close")

    def _guarded(self, sink, method, *arguments):
        try:
            getattr(sink, method)(*arguments)
        except Exception as error:
            what = getattr(sink, "path", None) or type(sink).__name__
            if sink in self.others:
                self.others.remove(sink)
                warnings.warn(
                    f"{what} failed and is left out from here on ({_first_line(error)})",
                    stacklevel=3,
                )
            elif not getattr(sink, "warned", False):
                sink.warned = True
                warnings.warn(
                    f"{what} cannot be written ({_first_line(error)}); the run goes on",
                    stacklevel=3,
                )


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]


def curves(folder: Path | str) -> None:
    """Draws `curves.png` in a run folder: return, episode length, losses and rate against
    environment steps.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return warnings.warn(missing("matplotlib"), stacklevel=2)
    folder = Path(folder)
    try:
        metrics, perf = read(folder / "metrics.jsonl"), read(folder / "perf.jsonl")
        panels = {
            "return": (metrics, "episode/return"),
            "episode length (steps)": (metrics, "episode/length"),
            "entropy": (metrics, "loss/entropy"),
            "value loss": (metrics, "loss/value"),
            "explained variance": (metrics, "loss/explained_variance"),
            "samples / s": (perf, "perf/rate"),
        }
        figure = Figure(figsize=(12, 6), layout="constrained")
        for axes, (title, (rows, name)) in zip(figure.subplots(2, 3).flat, panels.items()):
            points = [(row["samples"], row[name]) for row in rows if row.get(name) is not None]
            axes.plot(*zip(*points) if points else ([], []))
            axes.set(title=title, xlabel="samples")
            axes.grid(alpha=0.3)
        figure.savefig(folder / "curves.png", dpi=80)
    except OSError as error:
        warnings.warn(f"curves.png cannot be drawn ({error.strerror})", stacklevel=2)
