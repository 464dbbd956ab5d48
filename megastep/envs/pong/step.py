"""One step of Pong as one operation. N games, B lanes."""

import math
from pathlib import Path
from typing import NamedTuple

import torch

from megastep.engine import checks
from megastep.engine.agents import check_flag_on_cpu
from megastep.engine.devices import threads
from megastep.engine.launch_params import seed_params
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import launch

__all__ = ["CELL", "FEATURES", "GAME_FIELDS", "PIXELS", "LIBRARY", "PongStep", "pong_step"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
CELL = LIBRARY.constants["CELL"]  # units of position per cell; a cell is one pixel
FEATURES = LIBRARY.constants["N_FEATURES"]  # of an observation
GAME_FIELDS = LIBRARY.constants["GAME_FIELDS"]  # of a game's state
PIXELS = LIBRARY.constants["ROWS"], LIBRARY.constants["COLUMNS"]


class PongStep(NamedTuple):
    """The outcome of a step, one row per lane."""

    reward: torch.Tensor  # (B,): 1 for a point won, -1 for a point lost
    reset: torch.Tensor  # (B,) bool
    terminal: torch.Tensor  # (B,) bool
    truncated: torch.Tensor  # (B,) bool
    points_won: torch.Tensor  # (B,): where a game ends, the fraction of its points won; else 0
    features: torch.Tensor | None  # (B, 1, 8) fp16; None if pixels are written instead


def pong_step(
    games: torch.Tensor,
    actions: torch.Tensor,
    error_flag: torch.Tensor,
    seed: int,
    *,
    restart: bool = False,
    points: int = 1,
    limit: int = 1000,
    tracker_speed: float = 0.5,
    pixels: torch.Tensor | None = None,
) -> PongStep:
    """Plays one step of N games of Pong. A game that ended in the last step starts anew instead.

    Args:
        games: (13, N) int32, the state, updated in place. Zeros before the first ``restart``.
        actions: (B, 1) int64, 0 nothing, 1 up, 2 down. B = N: the left paddle of each game; B = 2
            N: the left and the right paddle.
        error_flag: (1,) int32, see :func:`~megastep.engine.check_flag`.
        seed: the generator's key; each serve draws once.
        restart: start all games anew.
        points: points that win a game.
        limit: steps after which a game is truncated.
        tracker_speed: maximum speed, in cells per step, of the right paddle if it is not a lane.
        pixels: (B, 1, 1, 30, 40) uint8, written instead of features.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
        EngineError: on the CPU, if an action is out of range.
    """
    n, device = checks.length("games", games, axis=1), games.device
    n_lanes = checks.length("actions", actions)
    if n_lanes not in (n, 2 * n) or actions.device != device:
        raise ValueError(
            f"actions must have one or two lanes for each of the {n} games, on {device}, but "
            f"{n_lanes} lanes on {actions.device} were given"
        )
    flags = [torch.empty(n_lanes, dtype=torch.bool, device=device) for _ in range(3)]
    reward, points_won = (torch.empty(n_lanes, device=device) for _ in range(2))
    features, pixels_at = None, 0
    if pixels is None:
        features = torch.empty((n_lanes, 1, FEATURES), dtype=torch.float16, device=device)
    else:
        shape = n_lanes, 1, 1, *PIXELS
        pixels_at = checks.address("pixels", pixels, shape, torch.uint8, device)
        if pixels_at % 8:
            raise ValueError("pixels must start at a multiple of 8 bytes, as a whole tensor does")
    speed = checks.number("tracker_speed", tracker_speed, -math.inf, PIXELS[1], "cells per step")
    if speed < 0:
        raise ValueError(f"tracker_speed must be at least 0 cells per step, not {speed:g}")
    launch(
        *(LIBRARY, "pong_step", device, n),
        games=checks.address("games", games, (GAME_FIELDS, n), torch.int32, device),
        actions=checks.address("actions", actions, (n_lanes, 1), torch.int64, device),
        reward=reward,
        reset=flags[0],
        terminal=flags[1],
        truncated=flags[2],
        points_won=points_won,
        features=features,
        pixels=pixels_at,
        error_flag=checks.address("error_flag", error_flag, (1,), torch.int32, device),
        **seed_params(seed),
        n_envs=n,
        n_sides=n_lanes // n,
        restart=int(checks.flag("restart", restart)),
        points=checks.integer("points", points, 1, 2**31 - 1),
        limit=checks.integer("limit", limit, 1, 2**31 - 1),
        tracker_speed=round(CELL * speed),
        n_threads=threads(),
    )
    check_flag_on_cpu(error_flag)
    reset, terminal, truncated = flags
    return PongStep(reward, reset, terminal, truncated, points_won, features)
