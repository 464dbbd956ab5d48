"""A scripted policy for Pong that acts on observations alone. B lanes."""

from collections.abc import Mapping
from pathlib import Path

import torch

from megastep.arrdict import arrdict
from megastep.kernels.build.kernel_library import KernelLibrary

__all__ = ["Tracker"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
FEATURES = LIBRARY.constants["N_FEATURES"]
PIXELS = LIBRARY.constants["ROWS"], LIBRARY.constants["COLUMNS"]
NOTHING, UP, DOWN = 0, 1, 2
PADDLE_ROWS, PADDLE_GREY, BALL_GREY = (
    LIBRARY.constants[name] for name in ("PADDLE_ROWS", "PADDLE_GREY", "BALL_GREY")
)
BALL_OFFSET = 6  # the feature: how far the ball is below the paddle's centre, 1 at its edge
NEAR = 0.5  # cells; a move is one cell, so one that starts nearer only overshoots


class Tracker:
    """Plays Pong as the environment's own opponent does: keeps its paddle level with the ball.

    The environment's tracker moves a fraction of a cell per step. A lane moves whole cells, so this
    policy moves every ``1 / tracker_speed`` steps. It reads features or pixels and has no weights.

    Args:
        tracker_speed: maximum mean speed, in cells per step; above 1 is as 1.
    """

    def __init__(self, tracker_speed: float = 0.5):
        self.tracker_speed = tracker_speed

    def initial(self, n_lanes: int, device: torch.device | str | None = None) -> arrdict:
        """Returns the initial state: ``saved`` (B,), cells that the paddle may move."""
        return arrdict(saved=torch.zeros(n_lanes, device=device))

    def __call__(
        self,
        world: Mapping,
        state: Mapping,
        sample: bool = True,
        generator: torch.Generator | None = None,
    ) -> tuple[arrdict, arrdict]:
        """Chooses actions (B, 1) for the lanes of a world of Pong, by the state of the last step or
        :meth:`initial`; ``sample`` and ``generator`` change nothing. Returns (arrdict(actions), new
        state). ValueError if the observations are not Pong's.
        """
        below = _cells_below(world["obs"])
        saved = state["saved"].masked_fill(world["reset"], 0.0) + self.tracker_speed
        saved = saved.clamp(max=1.0)
        moves = (below.abs() > NEAR) & (saved >= 1)
        actions = torch.where(moves, torch.where(below > 0, DOWN, UP), NOTHING)
        return arrdict(actions=actions[:, None]), arrdict(saved=saved - moves.float())


def _cells_below(obs) -> torch.Tensor:
    """Returns (B,): how many cells the ball is below the centre of a lane's paddle."""
    shape = getattr(obs, "shape", None)
    if shape is not None and shape[1:] == (1, FEATURES):
        return obs[:, 0, BALL_OFFSET].float() * (PADDLE_ROWS / 2)
    if shape is not None and shape[1:] == (1, 1, *PIXELS):
        image = obs[:, 0, 0]
        ball = (image == BALL_GREY).any(2).byte().argmax(1)
        top = (image[:, :, 0] == PADDLE_GREY).byte().argmax(1)
        return (ball - top + 0.5 - PADDLE_ROWS / 2).float()
    raise ValueError("the tracker needs the features or the pixels of Pong as observations")
