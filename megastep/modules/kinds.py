"""Kinds of objects: their tensors and methods. N environments, A agents per environment, K objects
of a kind, D layouts.
"""

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from megastep import engine
from megastep.engine import checks
from megastep.engine.objects import NUMBERS
from megastep.ragged import RaggedNumpy

if TYPE_CHECKING:
    from megastep.modules.objects import Objects

#: The tensors of a kind.
TENSORS = "positions", "angles", "sizes", "colours", "visible", "solid", "open", "carriers"
REACH = 0.05  # metres between surfaces at which an agent touches an object
_DISC, _DOOR = NUMBERS["disc"], NUMBERS["door"]
_INTO_WALL = 0.001  # metres that a door is longer than its opening, on either side


class Kind:
    """The objects of one kind. Its tensors are views of the engine's: write into them in place.

    Attributes:
        positions: (N, K, 2) metres; of a carried object, its carrier's.
        angles: (N, K) degrees.
        sizes: (N, K) metres.
        colours: (N, K) int32, indices into the colours.
        visible, solid, open: (N, K) bool. An open object is as if it were not there.
        carriers: (N, K) int32, the agent that carries it, or -1.
        slots: the kind's objects among all of an environment.
    """

    tensors = TENSORS

    def __init__(self, objects: "Objects", name: str, slots: slice):
        self._objects, self.name, self.slots = objects, name, slots
        self._agents = torch.arange(objects.core.n_agents, device=objects.core.device)

    def __len__(self) -> int:
        return self.slots.stop - self.slots.start

    def __getattr__(self, name: str) -> torch.Tensor:
        if name not in TENSORS:
            is_of_movable = hasattr(engine.Objects, name)
            hint = " (only kinds with movable=True have it)" if is_of_movable else ""
            raise AttributeError(f"{self.__dict__.get('name')} has no attribute {name!r}{hint}")
        return getattr(self._objects.all, name)[:, self.slots]

    def __setattr__(self, name: str, value: object) -> None:
        if name not in self.tensors:
            return super().__setattr__(name, value)
        own = getattr(self, name)
        is_tensor = isinstance(value, torch.Tensor)  # `doors.open |= mask` assigns `own`
        if not is_tensor or (value.data_ptr(), value.shape) != (own.data_ptr(), own.shape):
            kind = f"objects[{self.name!r}]"
            raise AttributeError(
                f"{name} cannot be replaced; write into it: {kind}.{name}[:] = ..."
            )

    def place(self, mask: torch.Tensor, colours: torch.Tensor | int | None = None) -> None:
        """Puts objects at random points in rooms, on no agent and no other object.

        Call it after the spawner: points are of the layout that an environment shows.

        Args:
            mask: (N,) or (N, K) bool.
            colours: (N, K) or (K,) integers, or one; their new colours. Default: they keep theirs.
        """
        mask, objects = self._broadcast(mask), self._objects
        self._paint(mask, colours)
        objects._mask.zero_()
        objects._mask[:, self.slots] = mask
        core, points = objects.core, (objects.points, objects.counts)
        engine.place_objects(core.scenery, core.agents, objects._mask, *points, objects.seed)

    def remove(self, mask: torch.Tensor) -> None:
        """Has objects vanish where ``mask``, (N,) or (N, K) bool, is True."""
        mask = self._broadcast(mask)
        self.visible.logical_and_(~mask)
        self.carriers.masked_fill_(mask, -1)

    def touching(self, reach: float = REACH) -> torch.Tensor:
        """Returns (N, A, K) bool: which agents are within ``reach`` metres of which objects'
        edges. Nobody touches an object that is not there, or is carried.
        """
        if reach != 0:
            checks.number("reach", reach, 0, math.inf, "metres")
        agents, objects = self._objects.core.agents, self._objects.all
        offset = agents.positions[:, :, None] - self.positions[:, None]
        angle = torch.deg2rad(self.angles)[:, None]
        sine, cosine = angle.sin(), angle.cos()
        ahead = (cosine * offset[..., 0] + sine * offset[..., 1]).abs()
        aside = (cosine * offset[..., 1] - sine * offset[..., 0]).abs()
        shapes, sizes = objects.shapes[self.slots], self.sizes[:, None]
        is_disc = shapes == _DISC
        has_width = ~is_disc & (shapes != _DOOR)
        ahead = (ahead - sizes * ~is_disc).clamp(min=0)
        aside = (aside - sizes * objects.widths[self.slots] * has_width).clamp(min=0)
        limit = agents.radius + reach + sizes * is_disc
        return (ahead.square() + aside.square() <= limit.square()) & self._loose()[:, None]

    def looked_at(self, centre_line: torch.Tensor) -> torch.Tensor:
        """Returns (N, A, K) bool: which objects are at the centre of which agents' screens, by
        ``centre_line``, (N, A) or (N, A, C) int32, of :func:`megastep.engine.observe`.
        """
        core, n_agent_lines = self._objects.core, self._objects.core.scenery.agent_lines.shape[1]
        objects = self._objects.all.at_lines(centre_line, n_agent_lines)
        objects = objects.view(core.n_envs, core.n_agents, -1, 1)
        own = torch.arange(self.slots.start, self.slots.stop, device=core.device)
        return (objects == own).any(2)

    def carry(self, mask: torch.Tensor) -> None:
        """Has agents pick up objects where ``mask``, (N, A, K) bool, is True. If several want one,
        the first has it. Nobody picks up what is not there, or carried.
        """
        mask = self._of_agents(mask)
        taken = mask.any(1) & self._loose()
        self.carriers.copy_(torch.where(taken, mask.int().argmax(1).int(), self.carriers))

    def carried(self) -> torch.Tensor:
        """Returns (N, A, K) bool: which agents carry which objects."""
        return self.carriers[:, None] == self._agents[:, None]

    def drop(self, mask: torch.Tensor) -> None:
        """Has agents put down, where they are, what they carry, where ``mask``, (N, A) or (N, A, K)
        bool, is True.
        """
        self.carriers.masked_fill_((self.carried() & self._of_agents(mask)).any(1), -1)

    def _loose(self) -> torch.Tensor:
        return self.visible & ~self.open & (self.carriers < 0)

    def _broadcast(self, mask) -> torch.Tensor:
        n, k = self.visible.shape
        is_mask = isinstance(mask, torch.Tensor) and mask.dtype == torch.bool
        if not is_mask or mask.shape not in ((n,), (n, 1), (n, k)):
            raise ValueError(
                f"mask must be a bool tensor of shape ({n},) or ({n}, {k}), one per environment or "
                f"per {self.name}"
            )
        return mask.view(n, -1).expand(n, k)

    def _of_agents(self, mask) -> torch.Tensor:
        (n, k), a = self.visible.shape, len(self._agents)
        is_mask = isinstance(mask, torch.Tensor) and mask.dtype == torch.bool
        if not is_mask or mask.shape not in ((n, a), (n, a, 1), (n, a, k)):
            raise ValueError(
                f"mask must be a bool tensor of shape ({n}, {a}) or ({n}, {a}, {k}), one per agent "
                f"or per agent and {self.name}"
            )
        return mask if mask.ndim == 3 else mask[..., None]

    def _paint(self, mask, colours) -> None:
        if isinstance(colours, int):
            self.colours.masked_fill_(mask, colours)
        elif colours is not None:
            self.colours.copy_(torch.where(mask, colours.to(self.colours), self.colours))


class Doors(Kind):
    """The doors of homes: a :class:`Kind` whose objects each close a doorway.

    Attributes:
        n_doorways: (D,) int64, doors that each layout has.
        poses: (D, K, 4) float32, of each: x and y in metres, angle in degrees, half the length.
    """

    def __init__(self, objects: "Objects", name: str, slots: slice, openings: RaggedNumpy):
        super().__init__(objects, name, slots)
        shape, device = (len(openings), len(self)), self.positions.device
        poses = np.zeros((*shape, 4), np.float32)
        for d in range(len(openings)):
            a, b = np.asarray(openings[d], float)[: len(self)].swapaxes(0, 1)
            along = b - a
            poses[d, : len(a), :2] = (a + b) / 2
            poses[d, : len(a), 2] = np.degrees(np.arctan2(along[:, 1], along[:, 0]))
            poses[d, : len(a), 3] = np.hypot(*along.T) / 2 + _INTO_WALL
        self.poses = torch.as_tensor(poses, device=device)
        self.n_doorways = torch.as_tensor(openings.widths, device=device).clamp(max=len(self))

    def place(self, mask: torch.Tensor, colours: torch.Tensor | int | None = None) -> None:
        """Puts a shut door into each doorway of the layout that an environment shows. Arguments as
        of :meth:`Kind.place`.
        """
        mask = self._broadcast(mask)
        self._paint(mask, colours)
        layout = self._objects.core.scenery.layout.long()
        poses = self.poses[layout]
        self.positions.copy_(torch.where(mask[..., None], poses[..., :2], self.positions))
        self.angles.copy_(torch.where(mask, poses[..., 2], self.angles))
        self.sizes.copy_(torch.where(mask, poses[..., 3], self.sizes))
        exists = torch.arange(len(self), device=layout.device) < self.n_doorways[layout][:, None]
        self.visible.copy_(torch.where(mask, exists, self.visible))
        self.open.logical_and_(~mask)
