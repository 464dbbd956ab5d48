"""Learning curves of a run, drawn from its JSON lines."""

import warnings
from pathlib import Path

from megastep.agents.training import json_lines
from megastep.agents.training.optional_packages import not_installed


def plot_curves(folder: Path | str) -> None:
    """Draws `curves.png` in a run folder: return, episode length, losses and training speed.

    Warns if matplotlib is not installed, a file cannot be read, or the disk is full.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return warnings.warn(not_installed("matplotlib"), stacklevel=2)
    folder = Path(folder)
    try:
        metrics = json_lines.read(folder / "metrics.jsonl")
        perf = json_lines.read(folder / "perf.jsonl")
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
