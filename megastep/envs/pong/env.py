"""Pong: two paddles return a ball, on a court of 40 x 30 cells.

N environments of one lane, the left side, or with self-play of two, so B = N or 2 N lanes. No
geometry: the whole step is the engine's :func:`~megastep.engine.pong`.
"""

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field

from megastep import engine, spaces
from megastep.arrdict import arrdict, numpyify
from megastep.envs.common import DisplayedEnv
from megastep.envs.pong.step import CELL, FEATURES, GAME_FIELDS, PIXELS, pong_step
from megastep.settings import MAX_ENVS, checked

__all__ = ["Pong"]

ROWS, COLUMNS = PIXELS
PADDLE = 4  # cells that a paddle is high
TEXT = {0: " ", 85: ".", 170: "|", 255: "o"}  # by the grey of a pixel


class Pong(DisplayedEnv):
    """A reward of 1 for a point won, -1 for a point lost.

    The ball flies a cell per step across the court, and up to a cell up or down: the further from
    its middle a paddle of 4 cells hits it, the steeper. Three actions: 0 nothing, 1 a cell up, 2 a
    cell down. A ball that a paddle misses is a point for the other side; it is served from the
    middle, at random. The right side is a tracker, whose paddle follows the ball at
    ``tracker_speed`` cells per step; or with ``self_play`` a lane too, which is shown and moves as
    if it were the left.

    Observation: eight features in fp16: own paddle, the other, the ball across and down, each from
    -1 to 1; its speed across and down in cells per step; how far it is below the middle of own
    paddle and of the other, 1 at the edge and no more than 2. Or with ``pixels`` a picture of 30 x
    40 uint8: the ball 255, the paddles 170, where the ball was a step ago 85. Pictures are one
    buffer, which every step writes anew.

    Terminal when a side has ``points`` points: one, or say 21 for a game. Truncated after ``limit``
    steps per such point. Its metric is ``points_won``, the share of the points played, 0.5 where
    none was.
    """

    fps = 30.0

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
        self.obs_space = spaces.MultiVector(1, FEATURES)
        n_lanes = n_envs * self.n_agents
        engine.fit(n_envs, 64 + self.n_agents * (64 + pixels * ROWS * COLUMNS), self.device)
        on = dict(device=self.device)
        self.games = torch.zeros((GAME_FIELDS, n_envs), dtype=torch.int32, **on)
        self.error_flag = torch.zeros(1, dtype=torch.int32, **on)
        self.no_actions = torch.zeros((n_lanes, 1), dtype=torch.int64, **on)
        self.pixels = None
        if pixels:
            self.obs_space = spaces.MultiImage(1, 1, ROWS, COLUMNS, dtype=torch.uint8)
            shape = n_lanes, *self.obs_space.shape
            self.pixels = torch.zeros(shape, dtype=torch.uint8, **on)

    def reset(self) -> arrdict:
        """Starts every episode anew. Returns a world."""
        return self._world(self.no_actions, restart=True)

    def step(self, decision: Mapping) -> arrdict:
        """One step by ``decision.actions`` (B, 1). Returns a world."""
        return self._world(decision["actions"])

    def _world(self, actions, restart=False):
        played = pong_step(
            self.games,
            actions,
            self.error_flag,
            self.seed,
            restart=restart,
            points=self.points,
            limit=self.limit,
            tracker_speed=self.tracker_speed,
            pixels=self.pixels,
        )
        return arrdict(
            obs=played.features if self.pixels is None else self.pixels,
            reward=played.reward,
            reset=played.reset,
            terminal=played.terminal,
            truncated=played.truncated,
            metrics=arrdict(points_won=played.points_won),
        )

    def check(self) -> None:
        """EngineError if the engine has flagged an error since the last check. Waits for the
        device, so not for inside a step.
        """
        engine.check_flag(self.error_flag)

    def state(self, e: int = 0) -> arrdict:
        """What :meth:`plot_state` draws of environment ``e``: ``ball`` and ``last_ball`` (2,), x
        and y, and ``paddles`` (2,), the tops of the left and the right, in cells from the court's
        top left; ``scores`` (2,) and the game's ``age`` in steps.
        """
        game = self.games[:, e].clone()
        places = game / CELL
        return arrdict(
            ball=places[:2],
            last_ball=places[4:6],
            paddles=places[6:8],
            scores=game[8:10],
            age=game[10],
        )

    @staticmethod
    def picture(state: arrdict) -> np.ndarray:
        """(30, 40) uint8: the pixels that the left side sees in a numpyified :meth:`state`."""
        pixels = np.zeros((ROWS, COLUMNS), np.uint8)
        for top, column in zip(state.paddles.astype(int), (0, -1), strict=True):
            pixels[top : top + PADDLE, column] = 170
        for (x, y), grey in ((state.last_ball, 85), (state.ball, 255)):
            pixels[int(y), int(x)] = grey
        return pixels

    def text(self, e: int = 0) -> str:
        """Environment ``e`` as it is now, for a terminal: the score above 30 lines of the court."""
        state = numpyify(self.state(e))
        lines = ["".join(TEXT[grey] for grey in row) for row in self.picture(state).tolist()]
        left, right = state.scores
        score, edge = f"{left} : {right}".center(COLUMNS).rstrip(), COLUMNS * "-"
        return "\n".join([score, edge, *(line.rstrip() for line in lines), edge])

    @classmethod
    def plot_state(cls, state: arrdict) -> Any:
        """A matplotlib figure of a numpyified :meth:`state`: the court and the score."""
        from matplotlib.figure import Figure

        left, right = state.scores
        figure = Figure(figsize=(6, 4.8), dpi=100, layout="constrained")
        court = figure.subplots()
        court.set_title(f"step {state.age}, {left} : {right}")
        court.imshow(cls.picture(state), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
        court.set_xticks([])
        court.set_yticks([])
        return figure
