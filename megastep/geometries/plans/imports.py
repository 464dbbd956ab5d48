"""Imports the floor plans of an archive or folder, in parallel processes, or one of one's own."""

import contextlib
import functools
import itertools
from collections.abc import Callable, Iterator
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
PENDING = 4  # batches per process that are read ahead
#: What libraries raise for broken files, but for ValueError.
UNREADABLE = (
    *(shapely.errors.GEOSException, RecursionError, MemoryError, ArithmeticError, LookupError),
    *(TypeError, AttributeError, AssertionError),
)
SHOWN = 12  # plans of the contact sheet


class Plan(NamedTuple):
    """What a file became: geometries and notes, or why it is refused."""

    name: str
    geometries: list[dotdict]
    notes: list[Notes]
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
    """Turns whatever a stranger's file makes libraries raise into a ValueError."""
    try:
        yield
    except UNREADABLE as error:
        raise ValueError(f"it cannot be read ({type(error).__name__}: {_line(error)})") from error


def _line(error) -> str:
    return " ".join(str(error).split())[:300] or type(error).__name__


def first_home(options: Options, member: safe.Member) -> tuple[Drawing, dotdict]:
    """Returns the first floor of a file that is a home, and its geometry."""
    reader = READERS[options.source]
    for drawing in reader.read(member.content or b"", options.per):
        with contextlib.suppress(ValueError):
            return drawing, _home(drawing, options.sealed, reader.TOLERANCE)[0]
    raise ValueError(f"{member.name!r} has no home")


def read(options: Options, member: safe.Member) -> Plan:
    """Returns the plan of a file. A floor that is no home is a warning if another floor is one."""
    name, reader = member.name, READERS[options.source]
    if member.content is None:
        return Plan(name, [], [], member.refusal)
    made, refusals = [], []
    try:
        with _refused():
            floors = reader.read(member.content, options.per)
    except ValueError as error:
        return Plan(name, [], [], _line(error))
    for drawing in floors:
        try:
            made.append(_home(drawing, options.sealed, reader.TOLERANCE))
        except ValueError as error:
            refusals.append(_line(error))
    if not made:
        return Plan(name, [], [], "; ".join(dict.fromkeys(refusals)))
    if refusals:
        made[0][1].warnings.append(f"{len(refusals)} floors are left out: {'; '.join(refusals)}")
    return Plan(name, [g for g, _ in made], [notes for _, notes in made])


def _read_all(options, members) -> list[Plan]:
    return [read(options, member) for member in members]


def run(
    options: Options, path: Path, show: Callable[[int], None], processes: int | None = None
) -> tuple[list[Plan], list[safe.Member]]:
    """Returns the plans of all files of an archive, folder or file, sorted by name, and the first
    files that are plans. `show` is called with the number of files that are read, by as many
    `processes`; None: one per core. Raises ValueError if none is a plan, or one is damaged.
    """
    n_processes = loky.cpu_count() if processes is None else processes
    suffix = READERS[options.source].SUFFIX
    members = safe.members(path, suffix)
    batches = iter(lambda: [*itertools.islice(members, BATCH)], [])
    plans: list[Plan] = []
    shown: list[safe.Member] = []

    def keep(batch, result) -> None:
        plans.extend(result)
        good = [one for one, plan in zip(batch, result) if plan.geometries]
        shown.extend(good[: SHOWN - len(shown)])
        show(len(plans))

    # a small archive is read here, as processes take a while to start
    for batch in itertools.islice(batches, 1 if n_processes > 1 else None):
        keep(batch, _read_all(options, batch))
    if (second := next(batches, None)) is not None:
        try:
            with workers.terminal_signals_blocked(), workers.pool(n_processes) as pool:
                submit = functools.partial(pool.submit, _read_all, options)
                pending = []
                for batch in itertools.chain([second], batches):
                    pending.append((batch, submit(batch)))
                    if len(pending) >= PENDING * n_processes:
                        done, result = pending.pop(0)
                        keep(done, result.result())
                for done, result in pending:
                    keep(done, result.result())
        except BrokenExecutor as error:
            text = "a process was killed, perhaps as memory is short; nothing is imported"
            raise ValueError(text) from error
    if not any(plan.geometries for plan in plans):
        reason = f"no file's name ends in {suffix}"
        if plans:
            reason = f"of {len(plans):,} files, {plans[0].name!r} is refused: {plans[0].refusal}"
        raise ValueError(f"{str(path)!r} has no floor plan that can be used; {reason}")
    return sorted(plans, key=lambda plan: plan.name), shown


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
