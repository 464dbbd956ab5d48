"""Pong: two paddles return a ball, on a court of 40 x 30 cells.

N environments. B lanes: N, the left paddles, or 2 N with self-play. There is no geometry.
"""

from typing import TYPE_CHECKING, Annotated

import numpy as np
import torch
from pydantic import Field

from megastep import engine, plotting, spaces
from megastep.arrdict import arrdict
from megastep.envs.common import BoardEnv, step_outputs, world_of
from megastep.envs.pong.tracker import LIBRARY, Tracker
from megastep.settings import MAX_ENVS, checked

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Pong", "Tracker"]

CELL = LIBRARY.constants["CELL"]  # units of position per cell; a cell is one pixel
FEATURES = LIBRARY.constants["N_FEATURES"]  # of an observation
GAME_FIELDS = LIBRARY.constants["GAME_FIELDS"]  # of a game's state
ROWS, COLUMNS = LIBRARY.constants["ROWS"], LIBRARY.constants["COLUMNS"]
PADDLE_ROWS = LIBRARY.constants["PADDLE_ROWS"]
LIMITS = 1, 1, 1, 1, 1, 1, 2, 2  # of the features' magnitudes


class Pong(BoardEnv):
    """Two-player Pong against a scripted tracker or in self-play.

    The ball moves one cell per step across the court and up to one cell up or down, more steeply
    the further from its centre a paddle of 4 cells hits it. If a paddle misses the ball, the other
    side wins a point, and the ball is served from the centre in a random direction. The right
    paddle is a tracker that follows the ball or, with ``self_play``, a lane that observes the game
    mirrored.

    Observation:
        (B, 1, 8) float16: y of the lane's paddle, y of the opponent's, x and y of the ball, all in
        [-1, 1]; the ball's velocity in x and y, in cells per step; how far the ball is below the
        centre of the lane's paddle and of the opponent's, 1 at the paddle's edge, clamped to
        [-2, 2].

        With ``pixels``: (B, 1, 1, 30, 40) uint8, the ball 255, paddles 170, the ball's last
        position 85. All steps write to the same buffer of images.

    Actions:
        (B, 1) integers: 0 nothing, 1 up, 2 down. A paddle moves one cell per step.

    Reward:
        1 for a point won, -1 for a point lost.

    Episode end:
        Terminal once a side has ``points`` points. Truncated after ``limit * points`` steps.

    Metrics:
        ``points_won``: points won, divided by the episode's points; 0.5 if there were none.

    Args:
        n_envs: number of environments.
        seed: of the serves.
        device: default: a GPU if there is one.
        points: points that end an episode; 21 for a whole game.
        limit: steps per point after which an episode is truncated.
        self_play: makes both paddles lanes; otherwise the right one is a scripted tracker.
        tracker_speed: maximum speed of the tracker, in cells per step.
        pixels: observe pixels instead of features.
    """

    fps, bot = 30.0, Tracker
    draws_row, ended_row = 11, 12
    controls = {"ArrowUp": 1, "ArrowDown": 2}

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 128,
        *,
        seed: int = 1,
        device: torch.device | str | None = None,
        points: Annotated[int, Field(ge=1, le=1000)] = 1,
        limit: Annotated[int, Field(ge=1, le=10**6)] = 1000,
        self_play: bool = False,
        tracker_speed: Annotated[float, Field(ge=0, lt=COLUMNS)] = 0.5,
        pixels: bool = False,
    ):
        self.n_envs, self.n_agents = n_envs, 2 if self_play else 1
        self.device = engine.device("auto" if device is None else device)
        self.roles = ("left", "right") if self_play else None
        self.seed, self.points, self.limit = seed, points, limit * points
        self.tracker_speed = tracker_speed
        self.action_space = spaces.MultiDiscrete(1, 3)
        self.obs_space = spaces.MultiVector(
            1, FEATURES, low=tuple(-limit for limit in LIMITS), high=LIMITS
        )
        engine.fit(n_envs, 64 + self.n_agents * (64 + pixels * ROWS * COLUMNS), self.device)
        self._allocate(GAME_FIELDS)
        self.pixels = None
        if pixels:
            self.obs_space = spaces.MultiImage(1, 1, ROWS, COLUMNS, dtype=torch.uint8)
            shape = n_envs * self.n_agents, *self.obs_space.shape
            self.pixels = torch.zeros(shape, dtype=torch.uint8, device=self.device)

    def _world(self, actions) -> arrdict:
        sizes = dict(features=0 if self.pixels is not None else FEATURES), {}
        outputs = step_outputs(self, 1, *sizes)
        self._play(
            *(LIBRARY, "pong_step", actions, outputs),
            pixels=self.pixels,
            n_sides=self.n_agents,
            points=self.points,
            limit=self.limit,
            tracker_speed=round(CELL * self.tracker_speed),
        )
        obs = outputs["features"] if self.pixels is None else self.pixels
        return world_of(outputs, obs, ["points_won"])

    def state(self, e: int = 0) -> arrdict:
        """Returns environment ``e`` for :meth:`plot_state`.

        ``ball`` and ``last_ball`` (2,) are x and y, ``paddles`` (2,) the tops of the left and the
        right paddle, all in cells from the court's top left. ``scores`` (2,); ``age`` in steps.
        """
        game = self.games[:, e].clone()
        cells = game / CELL
        return arrdict(
            ball=cells[:2],
            last_ball=cells[4:6],
            paddles=cells[6:8],
            scores=game[8:10],
            age=game[10],
        )

    @classmethod
    def plot_state(cls, state: arrdict) -> "Figure":
        """Draws the court and the score of a numpyified :meth:`state` as a matplotlib figure."""
        left, right = state.scores
        figure, court, _ = plotting.panels(title=f"step {state.age} · {left} : {right}")
        court.fit(np.array([0, 0]), np.array([COLUMNS, ROWS]))
        theme = court.style.colours
        court.polygon(
            [(0, 0), (COLUMNS, 0), (COLUMNS, ROWS), (0, ROWS)],
            fill=theme.floor,
            edge=theme.faint,
            width=1,
        )
        middle = [(COLUMNS / 2, 0), (COLUMNS / 2, ROWS)]
        court.line(middle, colour=theme.hatch, width=2)
        for side, top in enumerate(state.paddles):
            x, y = side * (COLUMNS - 1), ROWS - top
            corners = [(x, y), (x + 1, y), (x + 1, y - PADDLE_ROWS), (x, y - PADDLE_ROWS)]
            court.polygon(corners, 1, fill=plotting.AGENTS[side])
        for z, alpha, ball in (2, 0.35, state.last_ball), (3, 1.0, state.ball):
            x, y = np.floor(ball)
            court.disc((x + 0.5, ROWS - y - 0.5), 0.5, z, fill=theme.text, alpha=alpha)
        return figure
