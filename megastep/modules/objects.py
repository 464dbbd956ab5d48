"""Objects: keys, crates and doors as an environment's author uses them.

N environments, A agents per environment, K objects of a kind, D layouts.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from megastep import engine
from megastep.core import Core
from megastep.dotdict import dotdict
from megastep.engine import checks
from megastep.engine.objects import FORCE, GRIP, MAX_MASS, MAX_OBJECTS, RAMP_STEPS
from megastep.modules.kinds import Doors, Kind
from megastep.modules.lifecycle import derived_seed
from megastep.modules.movable import Movable
from megastep.modules.spawning import MAX_SPAWNS, cached_points, of_layouts
from megastep.ragged import RaggedNumpy
from megastep.scene import linear

#: Names of the colours, and the colours in sRGB. Each differs from the others in any light, and its
#: weakest channel has less of its light than any wall's.
COLOURS = {
    "red": "e6194b",
    "green": "1fa83a",
    "blue": "2450e0",
    "yellow": "e8d010",
    "magenta": "d020d8",
    "cyan": "10c0d8",
    "orange": "f07010",
    "violet": "6a18b8",
}
MAX_FRICTION = 100.0


class Disc(NamedTuple):
    """A kind of round objects."""

    count: int  # per environment
    radius: float = 0.1  # metres
    solid: bool = False  # they stop agents; movable ones do in any case
    movable: bool = False  # agents push them
    mass: float = 1.0  # kg, if movable; an agent has 1 kg
    friction: float = 0.5  # coefficient with the floor, if movable


class Crate(NamedTuple):
    """A kind of rectangular objects."""

    count: int  # per environment
    side: float = 0.3  # metres
    solid: bool = True  # as of discs, and so are the next three
    movable: bool = False
    mass: float = 1.0
    friction: float = 0.5
    width: float | None = None  # metres, up to the side; default: squares


class Ramp(NamedTuple):
    """A kind of ramps: movable rectangles that agents drive up from their low side, which is not
    drawn. It is the side at -x, at one end of the ramp's length.
    """

    count: int  # per environment
    side: float = 0.6  # metres, the length
    width: float = 0.4  # metres, up to the length
    mass: float = 1.0  # kg
    friction: float = 0.5  # coefficient with the floor


class Door(NamedTuple):
    """A kind of solid objects that close the doorways of homes, one each."""

    #: Of an environment at most; further doorways have no door. None: as many as the home with the
    #: most doorways has.
    count: int | None = None


def doorways(geometries: Sequence[dotdict]) -> RaggedNumpy:
    """Returns the segments (2, 2) float32 metres across the doorways of each geometry."""
    segments = [np.reshape(g.get("doors", ()), (-1, 2, 2)).astype(np.float32) for g in geometries]
    return RaggedNumpy(np.concatenate(segments), np.array([len(s) for s in segments]))


class Objects:
    """The objects of an environment, by kind: ``objects["key"]`` is a :class:`Kind`, or a
    :class:`Movable` if the kind is movable. They are invisible until they are placed. Cameras see
    them, agents bump into the solid ones, and all that an environment does with them is PyTorch on
    :attr:`Kind.positions` and other tensors.

    Args:
        geometries: those that the scenery was made from.
        core: the environment's core, whose ``scenery.objects`` they become. It can have only one.
        kinds: {name: :class:`Disc`, :class:`Crate`, :class:`Ramp`, :class:`Door`, or a number of
            discs}.
        colours: names or hexadecimal sRGB of the colours. Default: ``COLOURS``.
        lit: see :class:`megastep.engine.Objects`.
        n_points: points per layout at which objects are placed.
        seed: of the points and draws. Default: the core's.
        force: newtons, at most, by which an agent, of 1 kg, pushes.
        grip: newtons, at most, between an agent and what it holds.
        ramp_steps: steps for which an agent is elevated after it has driven up a ramp, and longer
            until it is over no movable object. It passes these then, but neither walls, nor other
            solid objects, nor agents.
        grab_elevated: elevated agents may grab and hold objects, and so ride on them.

    Attributes:
        all: the :class:`megastep.engine.Objects` of all kinds. Its ``elevated``, (N, A) int32, is
            above 0 for elevated agents, if there are ramps.
        points: (D, n_points, 2) float32 metres, where the largest disc or crate is 5 cm clear of
            every wall.

    Raises:
        ValueError: naming the argument that does not fit, or a geometry where nothing fits.
    """

    def __init__(
        self,
        geometries: Sequence[dotdict],
        core: Core,
        kinds: Mapping[str, int | Disc | Crate | Ramp | Door],
        colours: Sequence[str] = tuple(COLOURS),
        lit: bool = False,
        n_points: int = 128,
        seed: int | None = None,
        force: float = FORCE,
        grip: float = GRIP,
        ramp_steps: int = RAMP_STEPS,
        grab_elevated: bool = False,
    ):
        if core.scenery.objects is not None:
            raise ValueError("core has objects: give all kinds to one Objects")
        if not checks.instance("kinds", kinds, Mapping):
            raise ValueError("kinds must hold at least one kind of objects, but is empty")
        self.core = core
        geometries = of_layouts(geometries, core)
        shapes, sizes, widths, solid, movable, names, slots = [], [], [], [], [], [], {}
        openings = doorways(geometries)
        for name, kind in kinds.items():
            kind = Disc(kind) if isinstance(kind, int) else kind
            count = _count(name, kind, openings)
            size, width = 0.0, 1.0  # of doors, whose openings say it
            if isinstance(kind, Disc):
                size = checks.number(f"radius of {name}", kind.radius, 0, 100)
            elif isinstance(kind, (Crate, Ramp)):
                size = checks.number(f"side of {name}", kind.side, 0, 100) / 2
                if kind.width is not None and kind.width != kind.side:
                    width = checks.number(f"width of {name}", kind.width, 0, kind.side) / kind.side
            is_ramp = isinstance(kind, Ramp)
            moves = checks.flag(f"movable of {name}", getattr(kind, "movable", is_ramp))
            if moves and not isinstance(kind, Door):
                checks.number(f"mass of {name}", kind.mass, 0, MAX_MASS, "kg")
                if kind.friction != 0:
                    checks.number(f"friction of {name}", kind.friction, 0, MAX_FRICTION)
            slots[name] = slice(len(shapes), len(shapes) + count)
            shapes += [type(kind).__name__.lower()] * count
            sizes += [size] * count
            widths += [width] * count
            solid += [moves or getattr(kind, "solid", True)] * count
            movable += [moves] * count
            names += [f"{name} {k}" for k in range(count)]
        of_all = core.n_envs, shapes, _palette(colours), lit, names, core.device
        up = core.n_agents, ramp_steps, grab_elevated
        self.all = engine.Objects(*of_all, widths, movable, force, grip, *up)
        self.all.sizes.copy_(torch.tensor(sizes))
        self.all.solid.copy_(torch.tensor(solid))
        core.scenery.objects = self.all

        seed = core.seed if seed is None else checks.integer("seed", seed, 0)
        self.seed = derived_seed(seed, "objects")
        n_points = checks.integer("n_points", n_points, 1, MAX_SPAWNS)
        loose = [
            size * math.hypot(1, width) if shape in ("crate", "ramp") else size
            for shape, size, width in zip(shapes, sizes, widths)
        ]
        radius = max(core.agents.radius, *loose)
        try:
            points = cached_points(geometries, n_points, 1, radius, self.seed)
        except ValueError as error:
            largest = names[loose.index(max(loose))]
            raise ValueError(f"{error}: make {largest} smaller, or the room larger") from None
        self.points = torch.as_tensor(points, device=core.device)
        self.counts = torch.zeros_like(self.all.carriers)
        self._mask = torch.zeros_like(self.all.carriers, dtype=torch.bool)
        self.kinds: dict[str, Kind] = {}
        for name, kind in kinds.items():
            if isinstance(kind, Door):
                self.kinds[name] = Doors(self, name, slots[name], openings)
            elif isinstance(kind, Ramp) or isinstance(kind, (Disc, Crate)) and kind.movable:
                self.kinds[name] = Movable(self, name, slots[name])
                self.kinds[name].masses.fill_(kind.mass)
                self.kinds[name].frictions.fill_(kind.friction)
            else:
                self.kinds[name] = Kind(self, name, slots[name])

    def __getitem__(self, name: str) -> Any:
        return self.kinds[name]


def _count(name, kind, openings) -> int:
    if not isinstance(kind, (Disc, Crate, Ramp, Door)):
        raise ValueError(f"{name} must be a number, Disc, Crate, Ramp or Door, but is {kind!r}")
    if not isinstance(kind, Door):
        return checks.integer(f"the number of {name}", kind.count, 1, MAX_OBJECTS)
    most = int(openings.widths.max())
    if not most:
        raise ValueError(
            f"{name}: none of the geometries has a doorway to put a door into; homes have, boxes "
            "and mazes have not"
        )
    return most if kind.count is None else checks.integer(f"the number of {name}", kind.count, 1)


def _palette(colours) -> np.ndarray:
    try:
        return linear([COLOURS.get(name) or name for name in checks.items("colours", colours)])
    except (ValueError, TypeError, AttributeError):
        raise ValueError(
            f"colours must be of {', '.join(COLOURS)}, or hexadecimal such as 'e6194b', but "
            f"{colours!r} was given"
        ) from None
