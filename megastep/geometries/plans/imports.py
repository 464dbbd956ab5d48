"""Imports the floor plans of an archive or folder, in parallel processes, or one of one's own."""

import contextlib
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import NamedTuple

import loky
import numpy as np
import shapely

from megastep import workers
from megastep.dotdict import dotdict
from megastep.geometries import checks
from megastep.geometries.plans import cubicasa, houseexpo, maps, outlines, safe, svg
from megastep.geometries.plans.outlines import Drawing, Notes

READERS = {"cubicasa": cubicasa, "houseexpo": houseexpo}
BATCH = 16  # files that a process gets at a time
AHEAD = 8 * BATCH  # files per process that are held at once
#: What libraries raise for broken files, but for ValueError.
UNREADABLE = (
    *(shapely.errors.GEOSException, RecursionError, MemoryError, ArithmeticError, LookupError),
    *(TypeError, AttributeError, AssertionError),
)
SHOWN = 12  # plans of the contact sheet


class Plan(NamedTuple):
    """What a file became: geometries, notes and the first one's drawing, or why it is refused."""

    name: str
    geometries: Sequence[dotdict] = ()
    notes: Sequence[Notes] = ()
    drawing: Drawing | None = None
    refusal: str = ""


class Options(NamedTuple):
    """How plans are read."""

    source: str
    per: str = "floor"
    sealed: bool = True


def _home(drawing, sealed=True, tolerance=outlines.CURVED) -> tuple[dotdict, Notes]:
    """Returns the geometry of a drawing, and notes. Raises ValueError if it is no home."""
    with _refused():
        g, notes = outlines.geometry_of(drawing, sealed, tolerance)
        if (sentences := checks.errors(g)) and sealed:
            raise ValueError("; ".join(sentences))
        return g, notes


@contextlib.contextmanager
def _refused() -> Iterator[None]:
    """Turns whatever a stranger's file makes libraries raise into a ValueError of one line."""
    try:
        yield
    except UNREADABLE as error:
        raise ValueError(f"it cannot be read ({type(error).__name__}: {_line(error)})") from error


def _line(error) -> str:
    return " ".join(str(error).split())[:300] or type(error).__name__


def read(options: Options, member: safe.Member) -> Plan:
    """Returns the plan of a file. A floor that is no home is a warning if another floor is one."""
    name, reader = member.name, READERS[options.source]
    if member.content is None:
        return Plan(name, refusal=member.refusal)
    homes, refusals = [], []
    try:
        with _refused():
            floors = reader.read(member.content, options.per)
    except ValueError as error:
        return Plan(name, refusal=_line(error))
    for drawing in floors:
        try:
            homes.append((*_home(drawing, options.sealed, reader.TOLERANCE), drawing))
        except ValueError as error:
            refusals.append(_line(error))
    if not homes:
        return Plan(name, refusal="; ".join(dict.fromkeys(refusals)))
    geometries, notes, drawings = zip(*homes)
    if refusals:
        notes[0].warnings.append(f"{len(refusals)} floors are left out: {'; '.join(refusals)}")
    return Plan(name, geometries, notes, drawings[0])


def run(
    options: Options, path: Path, show: Callable[[int], None], processes: int | None = None
) -> list[Plan]:
    """Returns the plans of all files of an archive, folder or file, sorted by name, with the
    drawings of the first. `show` is called with the number of files that are read, by as many
    `processes`; None: one per core. Raises ValueError if none is a plan, or one is damaged.
    """
    n_processes = loky.cpu_count() if processes is None else processes
    suffix, read_one = READERS[options.source].SUFFIX, functools.partial(read, options)
    members, each, size = safe.members(path, suffix), map, BATCH
    plans: list[Plan] = []
    n_shown = 0
    with contextlib.ExitStack() as stack:
        try:
            while batch := [*itertools.islice(members, size)]:
                for plan in each(read_one, batch):
                    plans.append(plan if n_shown < SHOWN else plan._replace(drawing=None))
                    n_shown += plan.drawing is not None
                    show(len(plans))
                if each is map and n_processes > 1:  # many files, worth starting processes for
                    stack.enter_context(workers.terminal_signals_blocked())
                    pool = stack.enter_context(workers.pool(n_processes))
                    each, size = functools.partial(pool.map, chunksize=BATCH), AHEAD * n_processes
        except BrokenExecutor as error:
            text = "a process was killed, perhaps as memory is short; nothing is imported"
            raise ValueError(text) from error
    if not any(plan.geometries for plan in plans):
        reason = f"no file's name ends in {suffix}"
        if plans:
            reason = f"of {len(plans):,} files, {plans[0].name!r} is refused: {plans[0].refusal}"
        raise ValueError(f"{str(path)!r} has no floor plan that can be used; {reason}")
    return sorted(plans, key=lambda plan: plan.name)


# ---- One plan of one's own ----


class Own(NamedTuple):
    """A drawing or an image, and what it became."""

    original: Drawing | np.ndarray
    geometry: dotdict
    warnings: list[str]


def own_svg(path: Path, scale: float, walls: str = "wall", doors: str = "door") -> Own:
    """Returns the floor plan of an SVG. Arguments are those of `svg.read`. Raises ValueError."""
    member = safe.of_file(path, path.name)
    if member.content is None:
        raise ValueError(member.refusal)
    with _refused():
        drawing, warnings = svg.read(member.content, scale, walls, doors)
    g, notes = _home(drawing)
    return Own(drawing, g, warnings + notes.warnings)


def own_map(path: Path, metres_per_pixel: float | None = None) -> Own:
    """Returns the floor plan of a map. Arguments are those of `maps.load`. Raises ValueError."""
    with _refused():
        drawing, picture, warnings = maps.read(maps.load(path, metres_per_pixel))
    g, notes = _home(drawing)
    return Own(picture, g, warnings + notes.warnings)
