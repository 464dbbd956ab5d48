"""Objects that agents push, grab and lock. N environments, A agents per environment, K objects of a
kind.
"""

import torch

from megastep.engine import checks
from megastep.modules.kinds import Kind

#: The tensors that movable kinds have besides those of all kinds.
TENSORS = "velocity", "angvelocity", "masses", "frictions", "movable", "locked", "owners", "holders"


class Movable(Kind):
    """The objects of a movable kind. Agents push them by walking into them, and they push each
    other. What an agent grabs goes where it goes, and turns with it, until it lets go, or something
    holds the object back with more than ``grip`` newtons.

    Attributes:
        velocity: (N, K, 2) m/s.
        angvelocity: (N, K) deg/s.
        masses: (N, K) kg.
        frictions: (N, K), coefficients with the floor.
        movable: (N, K) bool. Where False, nothing moves it.
        locked: (N, K) bool. Where True, likewise.
        owners: (N, K) int32, the team that locked it, or -1.
        holders: (N, K) int32, the agent that holds it, or -1.
    """

    tensors = Kind.tensors + TENSORS

    def __init__(self, objects, name: str, slots: slice):
        super().__init__(objects, name, slots)
        first = objects.all.body_slots[slots.start]
        self._bodies = slice(first, first + len(self))

    def __getattr__(self, name: str) -> torch.Tensor:
        if name in TENSORS:
            return getattr(self._objects.all, name)[:, self._bodies]
        return super().__getattr__(name)

    def remove(self, mask: torch.Tensor) -> None:
        """Has objects vanish where ``mask``, (N,) or (N, K) bool, is True."""
        super().remove(mask)
        self._stop(self._broadcast(mask))

    def grab(self, mask: torch.Tensor) -> None:
        """Has agents grab objects, where they are, where ``mask``, (N, A, K) bool, is True. If
        several want one, the first has it. Nobody grabs what is not there, carried, held, or
        locked. Elevated agents grab nothing, unless they may.
        """
        objects, mask = self._objects.all, self._of_agents(mask)
        if objects.elevated is not None and not objects.grab_elevated:
            mask = mask & (objects.elevated <= 0)[..., None]
        free = self._loose() & ~self.locked & (self.holders < 0)
        taken = mask.any(1) & free
        self.holders.copy_(torch.where(taken, mask.int().argmax(1).int(), self.holders))
        objects.grabbed[:, self._bodies].logical_or_(taken)

    def held(self) -> torch.Tensor:
        """Returns (N, A, K) bool: which agents hold which objects."""
        return self.holders[:, None] == self._agents[:, None]

    def release(self, mask: torch.Tensor) -> None:
        """Has agents let go of what they hold where ``mask``, (N, A) or (N, A, K) bool, is True."""
        self.holders.masked_fill_((self.held() & self._of_agents(mask)).any(1), -1)

    def lock(self, mask: torch.Tensor, team: torch.Tensor | int) -> None:
        """Locks objects where ``mask``, (N,) or (N, K) bool, is True, for a team: an integer of
        at least 0, or (N, K) of them, of which negative ones lock nothing. Nothing moves them, and
        nobody holds them. What is locked keeps its owner.
        """
        mask = self._broadcast(mask) & self.visible & ~self.locked
        if isinstance(team, torch.Tensor):
            mask = mask & (team >= 0)
        else:
            team = checks.integer("team", team, 0)
        self.owners.copy_(torch.where(mask, team, self.owners))
        self.locked.logical_or_(mask)
        self._stop(mask)

    def unlock(self, mask: torch.Tensor, team: torch.Tensor | int) -> None:
        """Unlocks objects where ``mask``, (N,) or (N, K) bool, is True, if this team locked them.
        ``team`` is as of :meth:`lock`.
        """
        mask = self._broadcast(mask) & self.locked & (self.owners == team)
        self.locked.logical_and_(~mask)
        self.owners.masked_fill_(mask, -1)

    def _stop(self, mask: torch.Tensor) -> None:
        self.velocity.masked_fill_(mask[..., None], 0)
        self.angvelocity.masked_fill_(mask, 0)
        self.holders.masked_fill_(mask, -1)
