"""Imports the floor plans of a folder, in parallel processes, or one of one's own."""

import contextlib
import functools
import itertools
import os
import pickle
import resource
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import NamedTuple, TypeVar

import loky
import numpy as np

from megastep import workers
from megastep.dotdict import dotdict
from megastep.geometries import checks
from megastep.geometries.plans import cubicasa, houseexpo, maps, outlines, safe, svg
from megastep.geometries.plans.outlines import Drawing, Notes

T = TypeVar("T")
READERS = {"cubicasa": cubicasa, "houseexpo": houseexpo}
BATCH = 16  # files that a process gets at a time
AHEAD = 8 * BATCH  # files per process that are held at once
SHOWN = 12  # plans of the contact sheet
SECONDS = 12  # of a core, for a file; real plans take up to one


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
    sealed: bool = True


def _home(drawing, sealed=True, tolerance=outlines.CURVED) -> tuple[dotdict, Notes]:
    """Returns the geometry of a drawing, and notes. Raises ValueError if it is no home."""
    g, notes = outlines.geometry_of(drawing, sealed, tolerance)
    if (sentences := checks.errors(g)) and sealed:
        raise ValueError("; ".join(sentences))
    return g, notes


def _limited(work: Callable[[], T]) -> T:
    """Returns what `work` returns, in a process that ends after SECONDS of a core; ValueError."""
    reading, writing = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads, which it does not use
        child = os.fork()
    if child == 0:
        try:
            resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
            try:
                result = (work(), "")
            except Exception as error:  # whatever a stranger's file makes libraries raise
                result = (None, _line(error))
            with open(writing, "wb") as file:
                pickle.dump(result, file)
        finally:
            os._exit(0)
    os.close(writing)
    with open(reading, "rb") as file:
        content = file.read()
    os.waitpid(child, 0)
    if not content:
        raise ValueError(f"it takes more than {SECONDS} s to read; leave out what is not a wall")
    value, refusal = pickle.loads(content)
    if refusal:
        raise ValueError(refusal)
    return value


def _line(error) -> str:
    text = " ".join(str(error).split())[:300]
    is_ours = isinstance(error, ValueError)
    return text if is_ours else f"it cannot be read ({type(error).__name__}: {text})"


def read(options: Options, member: safe.Member) -> Plan:
    """Returns the plan of a file. A floor that is no home is a warning if another floor is one."""
    try:
        return _limited(functools.partial(_read, options, member))
    except ValueError as error:
        return Plan(member.name, refusal=str(error))


def _read(options, member) -> Plan:
    reader, homes, refusals = READERS[options.source], [], []
    if member.content is None:
        raise ValueError(member.refusal)
    for drawing in reader.read(member.content):
        try:
            homes.append((*_home(drawing, options.sealed, reader.TOLERANCE), drawing))
        except Exception as error:
            refusals.append(_line(error))
    if not homes:
        raise ValueError("; ".join(dict.fromkeys(refusals)))
    geometries, notes, drawings = zip(*homes)
    if refusals:
        notes[0].warnings.append(f"{len(refusals)} floors are left out: {'; '.join(refusals)}")
    return Plan(member.name, geometries, notes, drawings[0])


def run(
    options: Options, path: Path, show: Callable[[int], None], processes: int | None = None
) -> list[Plan]:
    """Returns the plans of all files of a folder, or of a file, sorted by name, with the
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
    content = member.content

    def work() -> Own:
        drawing, warnings = svg.read(content, scale, walls, doors)
        g, notes = _home(drawing)
        return Own(drawing, g, warnings + notes.warnings)

    return _limited(work)


def own_map(path: Path, metres_per_pixel: float | None = None) -> Own:
    """Returns the floor plan of a map. Arguments are those of `maps.load`. Raises ValueError."""

    def work() -> Own:
        drawing, picture, warnings = maps.read(maps.load(path, metres_per_pixel))
        g, notes = _home(drawing)
        return Own(picture, g, warnings + notes.warnings)

    return _limited(work)
