"""Members that the environments share."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, cast

import torch

from megastep import engine
from megastep.arrdict import arrdict, numpyify
from megastep.core import Core
from megastep.modules import RandomSpawns
from megastep.schedules import Number, Scheduled
from megastep.types import Env

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["DisplayedEnv", "SceneryEnv", "Weight", "world_of"]

#: Weight of a part of a reward, a number or a schedule.
Weight = Annotated[Number, Scheduled(ge=0, le=1000)]


def world_of(step: Any, obs: Any, metrics: arrdict | None = None) -> arrdict:
    """Returns a world with the reward and the flags of an operation's outcome."""
    names = "reward", "reset", "terminal", "truncated"
    world = arrdict(obs=obs, **{name: getattr(step, name) for name in names})
    if metrics is not None:
        world["metrics"] = metrics
    return world


class DisplayedEnv:
    """An environment that is drawn by its own ``state(e)`` and ``plot_state(state)``, and begins
    episodes by its own ``_begin(mask)``.
    """

    _begin: Callable[[torch.Tensor], arrdict]
    _resets: engine.Resets
    plot_state: Callable[..., "Figure"]
    state: Callable[..., arrdict]

    def reset(
        self, seed: int | torch.Tensor | None = None, mask: torch.Tensor | None = None
    ) -> arrdict:
        """Starts a new episode in every lane, or in those of a mask. Returns the first world.

        Args:
            seed: of the episodes from now on, from 0 to 2**63 - 1, or a seed per lane, (B,) int64.
            mask: (B,) bool, lanes that begin. The others keep state and observation, unless their
                game begins anew with a lane of the mask, as in Pong. Returns the last world, with
                new rows in place.
        """
        return self._resets(cast(Env, self), self._begin, seed, mask)

    def display(self, e: int = 0) -> "Figure":
        """Draws environment ``e`` as it is now. Returns a matplotlib figure."""
        return self.plot_state(numpyify(self.state(e)))


class SceneryEnv(DisplayedEnv):
    """An environment built around a :class:`~megastep.core.Core`, its attribute ``core``."""

    core: Core
    spawner: RandomSpawns

    def check(self) -> None:
        """Raises EngineError if the engine flagged an error on the device since the last check.

        Synchronises host and device, so do not call it from ``step``.
        """
        engine.check(self.core.agents)

    @property
    def layout(self) -> torch.Tensor:
        """(N,) int32: the layout that each environment shows now, an index into ``geometries``."""
        return self.core.scenery.layout

    def weigh_layouts(self) -> torch.Tensor:
        """Has the layouts of new episodes be drawn by weights from now on, first by equal ones.
        Returns the cumulative weights, (D,) int32, to be changed in place.

        Raises:
            ValueError: if environments keep their layouts.
        """
        return self.spawner.weigh_layouts()
