"""Where the numbers of a run go: JSON lines and TensorBoard always, Weights & Biases if asked,
curves at the end.

`metrics.jsonl` holds what the seed determines, so two runs of one configuration write the same
bytes; rates and times are in `perf.jsonl`. A sink that fails is dropped with one warning; nothing
here can stop a run. T time, B lanes.
"""

import importlib
import json
import math
import os
import warnings
from pathlib import Path

#: How each optional part is called, and what installs it.
FEATURES = {
    "tensorboard": "TensorBoard events",
    "wandb": "Weights & Biases",
    "matplotlib": "curves.png",
    "av": "video.mp4",
}
#: Seconds that Weights & Biases may take to answer before the run goes on without it.
PATIENCE = 20


def missing(package):
    """The sentence for a package that is not installed."""
    return (
        f"{FEATURES[package]} left out: the package {package} is not installed; pip install "
        f"{package}"
    )


def is_word(value):
    """Whether a value is a plain field, such as what the learning rate follows, and no number."""
    return isinstance(value, str)


class JsonLines:
    """One object a line, written at once, so that a killed run loses none."""

    def __init__(self, path):
        self.path = Path(path)
        self.file = open(self.path, "a", encoding="utf-8")

    def write(self, step, values):
        # JSON knows no nan
        finite = {k: v if is_word(v) or math.isfinite(v) else None for k, v in values.items()}
        self.file.write(json.dumps({"samples": step, **finite}) + "\n")
        self.file.flush()

    def close(self):
        self.file.close()


def read(path):
    """The objects of a file of JSON lines; a line cut short by a crash or a full disk is passed
    over.
    """
    rows = []
    for line in Path(path).read_text(encoding="utf-8").splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return rows


def rewind(path, step):
    """Drops the lines after `step` environment steps: a resumed run writes them again."""
    path = Path(path)
    if path.exists():
        rows = [row for row in read(path) if row["samples"] <= step]
        path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")


class TensorBoard:
    def __init__(self, folder, step):
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            raise RuntimeError(missing("tensorboard")) from None
        self.writer = SummaryWriter(str(folder), purge_step=step or None)

    def write(self, step, values):
        for name, value in values.items():
            if not is_word(value):
                self.writer.add_scalar(name, value, step)

    def close(self):
        self.writer.close()


class Wandb:
    """Weights & Biases, online or offline; it never asks at the terminal and waits `PATIENCE`
    seconds at most.
    """

    def __init__(self, folder, project, mode, name, config):
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
        try:
            self.run = wandb.init(
                project=project,
                mode=mode,
                name=name,
                config=config,
                dir=str(folder),
                settings=wandb.Settings(init_timeout=PATIENCE, silent=True, console="off"),
            )
        except Exception as error:  # the package raises its own, the network's and the system's
            raise RuntimeError(
                f"Weights & Biases left out: it did not start ({_first_line(error)})"
            ) from None

    @staticmethod
    def _has_key(wandb):
        """Whether there is a key, in the environment or a file, without asking for one at the
        terminal.
        """
        try:
            return os.environ.get("WANDB_API_KEY") or wandb.login(prompt=False)
        except TypeError:  # older versions have no such argument
            return wandb.api.api_key

    def write(self, step, values):
        self.run.log({"samples": step, **values}, step=step)

    def close(self):
        self.run.finish()


class Metrics:
    """All sinks of one run folder. `step`: where a resumed run goes on; `wandb`: arguments of
    `Wandb`, or None.
    """

    def __init__(self, folder, step=0, wandb=None):
        folder = Path(folder)
        for name in ("metrics.jsonl", "perf.jsonl"):
            rewind(folder / name, step)
        self.metrics, self.perf = (
            JsonLines(folder / "metrics.jsonl"),
            JsonLines(folder / "perf.jsonl"),
        )
        self.others = []
        self._open(TensorBoard, folder / "tensorboard", step)
        if wandb is not None:
            self._open(Wandb, folder, **wandb)

    def _open(self, sink, *arguments, **options):
        try:
            self.others.append(sink(*arguments, **options))
        except Exception as error:
            warnings.warn(_first_line(error), stacklevel=3)

    def write(self, step, metrics, perf):
        """Writes one report, both dicts of name -> number or word, after `step` environment
        steps.
        """
        self._guarded(self.metrics, "write", step, metrics)
        self._guarded(self.perf, "write", step, perf)
        for sink in list(self.others):
            self._guarded(sink, "write", step, {**metrics, **perf})

    def close(self):
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


def _first_line(error):
    return (str(error) or type(error).__name__).splitlines()[0]


def curves(folder):
    """Draws `curves.png` in a run folder: return, episode length, losses and rate against
    environment steps.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return warnings.warn(missing("matplotlib"), stacklevel=2)
    folder = Path(folder)
    metrics, perf = read(folder / "metrics.jsonl"), read(folder / "perf.jsonl")
    panels = {
        "return": (metrics, ["episode/return"]),
        "episode length (steps)": (metrics, ["episode/length"]),
        "entropy": (metrics, ["loss/entropy"]),
        "value loss": (metrics, ["loss/value"]),
        "explained variance": (metrics, ["loss/explained_variance"]),
        "samples / s": (perf, ["perf/rate"]),
    }
    figure = Figure(figsize=(12, 6), layout="constrained")
    for axes, (title, (rows, names)) in zip(figure.subplots(2, 3).flat, panels.items()):
        for name in names:
            points = [(row["samples"], row[name]) for row in rows if row.get(name) is not None]
            axes.plot(*zip(*points) if points else ([], []), label=name)
        axes.set_title(title)
        axes.set_xlabel("samples")
        axes.grid(alpha=0.3)
    try:
        figure.savefig(folder / "curves.png", dpi=80)
    except OSError as error:
        warnings.warn(f"curves.png cannot be written ({error.strerror})", stacklevel=2)
