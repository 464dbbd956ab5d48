"""Learning curves of a run, drawn from its JSON lines."""

import io
import warnings
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from megastep.agents.runs import json_lines
from megastep.atomic_files import write_atomically

if TYPE_CHECKING:
    from megastep.agents.types import Row

MAX_COLUMNS = 4
#: Statistics of episodes that are not curves of their own: how many they are of, and their spread.
NOT_DRAWN = ("count", "window", "return_std")

#: Statistics that come first, and the label of what evaluations in training measured.
FIRST, EVALUATED = ("return", "success", "coverage", "won"), "evaluated"

#: label -> (samples, value) of each point
Lines = dict[str, list[tuple[int, float]]]


def plot_curves(folder: Path | str) -> None:
    """Draws `curves.png` in a run folder: large the return, then a panel for each other mean over
    episodes, with a line per group of lanes, for each loss, and for the training speed. What never
    changes has none. Does nothing before the first report.

    Lines are means over a twentieth of the reports, in a band of a standard deviation.

    Warns if a file cannot be read, the disk is full, or matplotlib fails.
    """
    folder = Path(folder)
    try:
        from matplotlib.figure import Figure  # which takes a while

        rows = [json_lines.read(folder / name) for name in ("metrics.jsonl", "perf.jsonl")]
        panels = panels_of(*rows)
        if not panels:
            return
        places = places_of(len(panels))
        n_rows, n_columns = (max(place[axis].stop for place in places) for axis in range(2))
        figure = Figure(figsize=(3.6 * n_columns, 2.7 * n_rows + 0.4))
        # in inches; a layout engine would take as long as the drawing
        grid = figure.add_gridspec(
            n_rows,
            n_columns,
            left=0.6 / figure.get_figwidth(),
            right=1 - 0.2 / figure.get_figwidth(),
            bottom=0.55 / figure.get_figheight(),
            top=1 - 0.75 / figure.get_figheight(),
            wspace=0.25,
            hspace=0.4,
        )
        for (title, lines), place in zip(panels.items(), places, strict=True):
            _draw(figure.add_subplot(grid[place]), title, lines, place == places[0])
        figure.suptitle(folder.absolute().name, x=0.6 / figure.get_figwidth(), ha="left")
        figure.supxlabel("samples", fontsize="medium")
        figure.savefig(image := io.BytesIO(), dpi=80)
        write_atomically(folder / "curves.png", image.getvalue())
    except (OSError, ImportError, ValueError) as error:  # also a backend that MPLBACKEND names
        reason = getattr(error, "strerror", None) or str(error).partition("\n")[0]
        warnings.warn(f"curves.png cannot be drawn ({reason})", stacklevel=2)


def places_of(n: int) -> list[tuple[slice, slice]]:
    """Returns (rows, columns) of each of n panels: the first is four times as large."""
    cells = [(i, j) for j in range(2, MAX_COLUMNS) for i in range(2)]
    cells += [(2 + k // MAX_COLUMNS, k % MAX_COLUMNS) for k in range(max(0, n - 1 - len(cells)))]
    small = [(slice(i, i + 1), slice(j, j + 1)) for i, j in cells[: n - 1]]
    return [(slice(0, 2), slice(0, 2)), *small]


def _draw(axes, title, lines, is_large) -> None:
    from matplotlib.ticker import EngFormatter

    for label, points in lines.items():
        x, y = np.array(points, float).T
        mean, deviation = smoothed(y)
        (line,) = axes.plot(x, mean, label=label, linewidth=2 if is_large else 1.5)
        colour = line.get_color()
        if len(x) == 1 or label == EVALUATED:
            axes.plot(x, y, "o", color=colour, markersize=4)
        axes.fill_between(x, mean - deviation, mean + deviation, color=colour, alpha=0.2, lw=0)
    if len(lines) > 1:
        axes.legend(fontsize="medium" if is_large else "small")
    axes.set_title(title, fontsize="large" if is_large else "medium")
    axes.locator_params("both", nbins=8 if is_large else 4)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(alpha=0.3)


def smoothed(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the mean and the standard deviation of values, (n,), around each of them: over n / 20
    values, fewer at the ends.
    """
    n = len(values)
    reach = np.minimum(n // 40, np.minimum(np.arange(n), np.arange(n)[::-1]))
    first, last = np.arange(n) - reach, np.arange(n) + reach + 1
    # relative to the mean, so that the squares of large numbers leave something to subtract
    centred = values - np.nanmean(values)
    sums = [np.concatenate([[0.0], np.cumsum(x)]) for x in (centred, centred**2)]
    means, squares = ((x[last] - x[first]) / (last - first) for x in sums)
    return means + np.nanmean(values), np.sqrt(np.maximum(squares - means**2, 0))


def panels_of(metrics: "list[Row]", perf: "list[Row]") -> dict[str, Lines]:
    """Returns the lines of each panel by its title, from the rows of a run's two files.

    Panels are in the order return, others of `FIRST`, other episode statistics, losses, speed. One
    whose values are all the same is left out, if there are others.
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
            elif kind == "eval":
                episodes[name][EVALUATED].append((row["samples"], value))
            elif kind == "loss":
                losses[key][""].append((row["samples"], value))
    for row in perf:
        if row.get("perf/rate") is not None:
            speed["samples / s"][""].append((row["samples"], row["perf/rate"]))
    first = {name: episodes.pop(name) for name in FIRST if name in episodes}
    panels: dict[str, Lines] = {**first, **episodes, **losses, **speed}
    varied = {title: lines for title, lines in panels.items() if _varies(lines)}
    return varied or panels


def _varies(lines) -> bool:
    values = [value for points in lines.values() for _, value in points]
    return len(values) == len(lines) or len({*values}) > 1
