"""Learning curves of a run, drawn from its JSON lines."""

import io
import warnings
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING

from megastep.agents.runs import json_lines
from megastep.agents.runs.atomic_files import write_atomically

if TYPE_CHECKING:
    from megastep.agents.types import Row

MAX_COLUMNS = 4
#: Statistics of episodes that are no curves of their own: how many they are of, and their spread.
NOT_DRAWN = ("count", "window", "return_std")

#: label -> (samples, value) of each point
Lines = dict[str, list[tuple[int, float]]]


def plot_curves(folder: Path | str) -> None:
    """Draws `curves.png` in a run folder: a panel for each mean over episodes, with a line per
    group of lanes, for each loss, and for the training speed. Does nothing before the first report.

    Warns if a file cannot be read, or the disk is full.
    """
    from matplotlib.figure import Figure  # which takes a while
    from matplotlib.ticker import EngFormatter

    folder = Path(folder)
    try:
        rows = [json_lines.read(folder / name) for name in ("metrics.jsonl", "perf.jsonl")]
        panels = panels_of(*rows)
        if not panels:
            return
        n_columns = min(MAX_COLUMNS, len(panels))
        n_rows = -(-len(panels) // n_columns)
        figure = Figure(figsize=(3.6 * n_columns, 2.7 * n_rows))
        # in inches; a layout engine would take as long as the drawing
        figure.subplots_adjust(
            left=0.6 / figure.get_figwidth(),
            right=1 - 0.2 / figure.get_figwidth(),
            bottom=0.55 / figure.get_figheight(),
            top=1 - 0.35 / figure.get_figheight(),
            wspace=0.25,
            hspace=0.4,
        )
        grid = figure.subplots(n_rows, n_columns, squeeze=False)
        for axes, (title, lines) in zip(grid.flat, panels.items()):
            for label, points in lines.items():
                axes.plot(*zip(*points), label=label)
            if len(lines) > 1:
                axes.legend(fontsize="small")
            axes.set_title(title, fontsize="medium")
            axes.locator_params("both", nbins=4)
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.grid(alpha=0.3)
        for axes in grid.flat[len(panels) :]:
            axes.set_axis_off()
        figure.supxlabel("samples", fontsize="medium")
        figure.savefig(image := io.BytesIO(), dpi=80)
        write_atomically(folder / "curves.png", image.getvalue())
    except OSError as error:
        warnings.warn(f"curves.png cannot be drawn ({error.strerror})", stacklevel=2)


def panels_of(metrics: "list[Row]", perf: "list[Row]") -> dict[str, Lines]:
    """Returns the lines of each panel by its title, from the rows of a run's two files.

    Panels are in the order return, length, other episode statistics, losses, speed.
    """
    episodes, losses, speed = (defaultdict(lambda: defaultdict(list)) for _ in range(3))
    for row in metrics:
        for key, value in row.items():
            kind, _, name = key.partition("/")
            name, _, group = name.partition("/")
            if value is None or name in NOT_DRAWN:
                continue
            if kind == "episode":
                episodes[name][group or "all"].append((row["samples"], value))
            elif kind == "loss":
                losses[key][""].append((row["samples"], value))
    for row in perf:
        if row.get("perf/rate") is not None:
            speed["samples / s"][""].append((row["samples"], row["perf/rate"]))
    return {**episodes, **losses, **speed}
