"""The sources of geometries: functions `(n, split, seed, **options) -> list`.

Their arguments are the settings of a run's `geometry`. The split is training, test or all; a split
with fewer than n geometries repeats them.
"""

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from megastep.dotdict import dotdict
from megastep.geometries import databases, mazes, memory_mazes, quadrants, toys
from megastep.geometries import files as npz
from megastep.geometries.homes import plan
from megastep.geometry import mirror_image
from megastep.imports import import_object
from megastep.settings import checked, closest

__all__ = [
    *("bench", "box", "column", "cubicasa", "files", "homes", "houseexpo", "maze", "memory_maze"),
    *("mixed", "quadrant", "suite"),
]

Count = Annotated[int, Field(ge=1, le=1_000_000)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
BENCH = Path(__file__).parent / "data" / "bench_homes.npz"
MIX = {"homes": 1000, "bench": 512, "maze": 300}  # the parts of `mixed`
SUITE = {  # the parts of `suite`
    "generated": {"source": "homes", "n": 500},
    "dense": {"source": "homes", "n": 500, "density": float(plan.DENSEST)},
    "bench": {"source": "bench", "n": 512},
    "perfect mazes": {"source": "maze", "n": 250},
    "braided mazes": {"source": "maze", "n": 250, "braid": 1.0},
    "box": {"source": "box", "n": 1},
}


def _draw(count, n, split, seed) -> list[int]:
    return databases.draw(databases.split_range(count, split), n, seed)


def box(n: Count = 1, split: str = "training", seed: Seed = 1, width: float = 5.0) -> list[dotdict]:
    """Returns one empty square room, n times.

    Args:
        n, split, seed: all draw the same one, n times.
        width: width of the room, in metres.
    """
    return [toys.box(width)] * n


def column(
    n: Count = 1, split: str = "training", seed: Seed = 1, width: float = 5.0, pillar: float = 1.0
) -> list[dotdict]:
    """Returns one square room with a pillar in its middle, n times.

    Args:
        n, split, seed: all draw the same one, n times.
        width: width of the room, in metres.
        pillar: width of the pillar, in metres.
    """
    return [toys.column(width, pillar)] * n


@functools.lru_cache(maxsize=2)
def _load(path, modified) -> list[dotdict]:
    return npz.load(path)


def files(n: Count = 512, split: str = "training", seed: Seed = 1, *, path: str) -> list[dotdict]:
    """Returns geometries from an `.npz` file. The last tenth of it is the test split.

    Args:
        n, split, seed: how many are drawn, from which split, in which order.
        path: the file.
    """
    file = Path(path)
    geometries = _load(file, file.stat().st_mtime_ns if file.exists() else 0)
    return [geometries[i] for i in _draw(len(geometries), n, split, seed)]


@checked
def homes(
    n: Count = 512,
    split: str = "training",
    seed: Seed = 1,
    outer: bool = True,
    density: Annotated[float, Field(ge=1, le=plan.DENSEST)] = 1.0,
    clutter: Annotated[float, Field(ge=0, le=1)] = 0.0,
) -> list[dotdict]:
    """Returns homes from the 5,000 generated ones of the package.

    Homes of another density or clutter are generated from as many seeds at their first use.

    Args:
        n, split, seed: how many are drawn, from which split, in which order.
        outer: if False, outer walls have no outer faces, which cannot be seen from inside.
        density: 3: more rooms, narrower doors and corridors, and furniture: three times as many
            walls.
        clutter: 1: furniture leaves narrow gaps to walls, to other furniture and in doorways.
    """
    indices = _draw(databases.COUNT, n, split, seed)
    if density == 1 and clutter == 0:
        return [databases.home(i, outer) for i in indices]
    options = dict(density=float(density), clutter=float(clutter), outer=outer)
    return databases.generated(databases.dense_home, indices, databases.SEEDS_EACH, **options)


def bench(n: Count = 512, split: str = "training", seed: Seed = 1) -> list[dotdict]:
    """Returns homes from the 512 dense ones on which the benchmarks run.

    Args:
        n, split, seed: how many are drawn, from which split, in which order.
    """
    return files(n, split, seed, path=str(BENCH))


def cubicasa(n: Count = 512, split: str = "training", seed: Seed = 1) -> list[dotdict]:
    """Returns floors of CubiCasa5k's real homes, which `megastep import source=cubicasa` imported.

    Args:
        n, split, seed: how many are drawn, from which split, in which order. Floors of one home
            are in the same split.
    """
    return databases.pick("cubicasa", n, split, seed)


def houseexpo(n: Count = 512, split: str = "training", seed: Seed = 1) -> list[dotdict]:
    """Returns floor plans of HouseExpo, which `megastep import source=houseexpo` imported.

    Args:
        n, split, seed: how many are drawn, from which split, in which order.
    """
    return databases.pick("houseexpo", n, split, seed)


def _generated(module, n, split, seed, **options) -> list[dotdict]:
    """Returns mazes that a module generates."""
    indices = _draw(module.COUNT, n, split, seed)
    return databases.generated(module.generate, indices, **options)


@checked
def maze(
    n: Count = 512,
    split: str = "training",
    seed: Seed = 1,
    size: Annotated[int, Field(ge=2, le=32)] = 8,
    corridor: Annotated[float, Field(ge=mazes.MIN_CORRIDOR, le=100)] = 1.0,
    thickness: Annotated[float, Field(ge=0.02, le=100)] = 0.2,
    braid: Annotated[float, Field(ge=0, le=1)] = 0.0,
) -> list[dotdict]:
    """Returns square mazes from 5,000 of them.

    Args:
        n, split, seed: how many are drawn, from which split, in which order.
        size: cells per side.
        corridor: width of the corridors, in metres. An agent needs 0.32.
        thickness: thickness of the walls, in metres.
        braid: fraction of the dead ends that is opened: 0 leaves a perfect maze.
    """
    lengths = dict(corridor=corridor, thickness=thickness)
    return _generated(mazes, n, split, seed, size=size, braid=braid, **lengths)


@checked
def memory_maze(
    n: Count = 512,
    split: str = "training",
    seed: Seed = 1,
    size: Annotated[int, Field(ge=9, le=15)] = 9,
    cell: Annotated[float, Field(ge=memory_mazes.MIN_CELL, le=10)] = 0.6,
) -> list[dotdict]:
    """Returns mazes of rooms and corridors, as those of Memory Maze, from 5,000 of each size.

    Args:
        n, split, seed: how many are drawn, from which split, in which order.
        size: cells per side: 9, 11, 13 or 15.
        cell: side of a cell, in metres.
    """
    return _generated(memory_mazes, n, split, seed, size=size, cell=cell)


@checked
def quadrant(
    n: Count = 512,
    split: str = "training",
    seed: Seed = 1,
    width: Annotated[float, Field(ge=4, le=100)] = 6.0,
    opening: Annotated[float, Field(ge=0.32, le=1)] = 0.45,
) -> list[dotdict]:
    """Returns square rooms with an inner room in a corner, as in OpenAI's hide and seek, from 5,000
    of them, which differ in the inner room's one or two openings.

    Args:
        n, split, seed: how many are drawn, from which split, in which order.
        width: width of the outer room, in metres. The inner room has half of it.
        opening: width of the openings, in metres.
    """
    return _generated(quadrants, n, split, seed, width=width, opening=opening)


@checked
def _use(weight: Annotated[int, Field(ge=1, le=1000)] = 1, mirror: bool = False) -> tuple:
    return weight, mirror


def _part(name, part) -> tuple[Callable, dict, int, bool]:
    """Returns a part of `mixed`: source, options, weight, if mirrored. ValueError for others."""
    options = dict(part) if isinstance(part, dict) else {"n": part}
    source = options.pop("source", name)
    known = [name for name in __all__ if name not in ("mixed", "suite")]
    if not isinstance(source, str) or source not in known and ":" not in source:
        raise ValueError(
            f"{source!r} is not a source; {closest(source, [*known, 'module:function'])}"
        )
    function = import_object(source) if ":" in source else globals()[source]
    used = {key: options.pop(key) for key in ("weight", "mirror") if key in options}
    signature = inspect.signature(function)
    try:
        signature.bind(**{"n": 1, "split": "training", "seed": 1, **options})
        weight, mirror = _use(**used)
    except TypeError as error:
        taken = ", ".join(signature.parameters)
        raise ValueError(
            f"{name}: {source}: {error}; it takes {taken}, and a source n, split and seed"
        ) from None
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    if function is files and not Path(str(options["path"])).is_file():  # before others are made
        raise ValueError(f"{name}: there is no file {str(options['path'])!r}")
    return function, options, weight, mirror


@checked
def mixed(
    n: Count | None = None, split: str = "training", seed: Seed = 1, parts: dict[str, Any] = MIX
) -> list[dotdict]:
    """Returns geometries of several sources, one after the other, each with the key `source`, the
    name of its part.

    Args:
        n: number of geometries, evenly spaced over the parts, or repeated; None: as many as the
            parts have.
        split: training, test or all, of each part.
        seed: which geometries are drawn, of each part without a seed of its own.
        parts: name -> number of geometries from the source of that name; or {source, n, options}
            with the name or import path of a source. Every part is of the same split, and of the
            same seed unless its options have one; it has at most as many geometries as that split
            of its source. With {weight: 2} the training split has each of them twice, and with
            {mirror: true} the mirror image of each as well.
    """
    geometries, uses = [], {name: _part(name, part) for name, part in parts.items()}
    for name, (source, options, weight, mirror) in uses.items():
        if options.get("n") == 0:
            continue
        try:
            drawn = checked(source)(**{"split": split, "seed": seed, **options})
            unique = list({id(g): g for g in drawn}.values())
            if split == "training":
                unique += [mirror_image(g) for g in unique] if mirror else []
                unique *= weight
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error
        # each another object, and so a layout of its own, as layouts are drawn evenly
        geometries += [dotdict(g, source=name) for g in unique]
    if not geometries:
        raise ValueError("its counts sum to 0; give at least one geometry: {homes: 512}")
    total = len(geometries)
    n = n or total
    return [geometries[i * total // n if n < total else i % total] for i in range(n)]


@checked
def suite(
    n: Count | None = None,
    split: str = "training",
    seed: Seed = 1,
    parts: dict[str, Any] = SUITE,
    plans: str | None = None,
) -> list[dotdict]:
    """Returns the homes of the fixed suite that agents are evaluated in, a `mixed` of all kinds.

    Args:
        n: number of geometries, as of `mixed`.
        split: training, test or all, of each part.
        seed: which geometries are drawn.
        parts: the parts, as of `mixed`.
        plans: a further part: `cubicasa` or `houseexpo`, if it is imported, or an `.npz` file of
            floor plans, whose part is called `plans`.
    """
    if plans in databases.IMPORTED:
        parts = parts | {plans: 512}
    elif plans is not None:
        parts = parts | {"plans": {"source": "files", "n": 512, "path": plans}}
    return mixed(n, split, seed, parts)
