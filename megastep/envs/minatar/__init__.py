"""MinAtar's games, equal to minatar 1.0.15 step for step. N environments, a lane each."""

import difflib
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
import torch
from pydantic import Field

from megastep import engine, plotting, spaces
from megastep.arrdict import arrdict
from megastep.envs.common import BoardEnv, step_outputs, world_of
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.settings import MAX_ENVS, checked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["MinAtar"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
_C = LIBRARY.constants
SIDE, AGE, LAST_ACTION = (_C[name] for name in ("SIDE", "AGE", "LAST_ACTION"))
#: The actions of each game that do something, by their numbers in the original.
ACTIONS = {
    "asterix": (0, 1, 2, 3, 4),
    "breakout": (0, 1, 3),
    "freeway": (0, 2, 4),
    "seaquest": (0, 1, 2, 3, 4, 5),
    "space_invaders": (0, 1, 3, 5),
}
KEYS = {1: "ArrowLeft", 2: "ArrowUp", 3: "ArrowRight", 4: "ArrowDown", 5: " "}


class Variant(NamedTuple):
    """A game, and the original's numbers of the actions that an agent has."""

    game: str
    actions: tuple[int, ...]

    def constant(self, name: str) -> int:
        """Returns a constant of this game's kernel."""
        return _C["_".join(filter(None, (self.game.upper(), name)))]


class MinAtar(BoardEnv):
    """The games of MinAtar (Young and Tian 2019), with the rules of minatar 1.0.15.

    Observation:
        (N, 1, C, 10, 10) uint8, 0 or 1: the original's channels, before rows and columns. C is 4 in
        Asterix and Breakout, 7 in Freeway, 10 in Seaquest and 6 in Space Invaders. All steps write
        to the same buffer.

    Actions:
        (N, 1) integers, a number for each action of the game. Of nothing, left, up, right, down and
        fire, in this order, a game has those that do something in it; ids that end in ``-v0`` have
        all six.

    Reward:
        1 for a brick, gold, a crossing, or an enemy shot. In Seaquest up to 10 for six divers.

    Episode end:
        Terminal when the original ends: Freeway after 2,501 steps. Truncated at the limit.

    Args:
        n_envs: number of environments.
        id: game: asterix, breakout, freeway, seaquest or space_invaders; or an id of Gymnasium's
            registry, such as MinAtar/Breakout-v1.
        sticky: chance that the last action is repeated instead.
        ramping: whether games become harder.
        limit: steps of an episode. Default: 1,000, as in gymnax, and no limit in Freeway.
        seed: of all that is random.
        device: default: a GPU if there is one.
    """

    fps = 10.0
    n_agents = 1
    draws_row, ended_row = _C["N_DRAWS"], _C["ENDED"]

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 128,
        *,
        id: str = "breakout",
        sticky: Annotated[float, Field(ge=0, le=1)] = 0.1,
        ramping: bool = True,
        limit: Annotated[int, Field(ge=1, le=10**6)] | None = None,
        seed: int = 1,
        device: torch.device | str | None = None,
    ):
        self.n_envs, self.seed, self.ramping = n_envs, seed, ramping
        self.device = engine.device("auto" if device is None else device)
        self.variant = variant_of(id)
        game, actions = self.variant
        # of words of 32 bits, those that are that many and a half
        self.sticky = max(0, min(math.ceil(sticky * 2**32 - 0.5), 2**32 - 1))
        self.limit = limit or (_C["FREEWAY_STEPS"] if game == "freeway" else 1000)
        self.controls = {KEYS[a]: i for i, a in enumerate(actions) if a}
        self.action_space = spaces.MultiDiscrete(1, len(actions))
        n_channels, n_fields = (self.variant.constant(name) for name in ("CHANNELS", "FIELDS"))
        n_lists = _C["LIST_FIELDS"] if game == "seaquest" else 0
        self.obs_space = spaces.MultiImage(
            1, n_channels, SIDE, SIDE, dtype=torch.uint8, low=0, high=1
        )
        engine.fit(n_envs, 64 + 4 * (n_fields + n_lists) + n_channels * SIDE**2, self.device)
        on: dict = dict(device=self.device)
        self.lists = torch.zeros((n_lists, n_envs), dtype=torch.int32, **on) if n_lists else None
        self.images = torch.zeros((n_envs, *self.obs_space.shape), dtype=torch.uint8, **on)
        self._allocate(n_fields, "lists")

    def _begin(self, mask) -> arrdict:
        self.games[LAST_ACTION].masked_fill_(mask, 0)  # so that a seed determines the episode
        return super()._begin(mask)

    def _world(self, actions) -> arrdict:
        outputs, numbers = step_outputs(self, 0, {}, {}), self.variant.actions
        self._play(
            *(LIBRARY, "minatar_step", actions, outputs),
            lists=self.lists,
            image=self.images,
            sticky=self.sticky,
            n_channels=self.images.shape[2],
            game=self.variant.constant(""),
            limit=self.limit,
            is_ramping=self.ramping,
            n_actions=len(numbers),
            action_set=sum(number << 4 * i for i, number in enumerate(numbers)),
        )
        return world_of(outputs, self.images, [])

    def state(self, e: int = 0) -> arrdict:
        """Returns environment ``e`` for :meth:`plot_state`: ``image`` (C, 10, 10) uint8, 0 or 1;
        ``age`` in steps.
        """
        return arrdict(image=self.images[e, 0].clone(), age=self.games[AGE, e].clone())

    @classmethod
    def plot_state(cls, state: arrdict) -> "Figure":
        """Draws the board of a numpyified :meth:`state` as a matplotlib figure, a colour for each
        channel, of several in a cell the last one's.
        """
        figure, board, _ = plotting.panels(title=f"step {state.age}")
        board.fit(np.array([0, 0]), np.array([SIDE, SIDE]))
        corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
        board.polygon(SIDE * corners, fill=board.style.colours.floor)
        for channel, row, column in np.argwhere(state.image):
            fill = plotting.AGENTS[channel % len(plotting.AGENTS)]
            board.polygon(corners + (column, SIDE - 1 - row), 1 + channel, fill=fill)
        return figure


def variant_of(id: str) -> Variant:
    """Returns the game and the actions of an id. ValueError names the nearest ids if there is
    none.
    """
    variants = {game: Variant(game, actions) for game, actions in ACTIONS.items()}
    for game in ACTIONS:
        name = f"MinAtar/{game.title().replace('_', '')}"
        variants |= {f"{name}-v0": Variant(game, (*range(6),)), f"{name}-v1": variants[game]}
    if id not in variants:
        near = difflib.get_close_matches(id, variants, 3, 0.3) or [*ACTIONS]
        raise ValueError(f"id: {id!r} is none of MinAtar's games; near are {', '.join(near)}")
    return variants[id]
