"""One step of Pong, as one operation of the device. N games, B lanes."""

import math
from typing import NamedTuple

import torch

from megastep.engine import checks
from megastep.engine.agents import check_flag_on_cpu
from megastep.engine.devices import threads
from megastep.engine.launch_params import seed_params
from megastep.kernels.build.launch import launch, params

__all__ = ["CELL", "FEATURES", "GAME_FIELDS", "PIXELS", "PongStep", "pong_step"]

GAME_FIELDS = 13  # of a game of Pong
FEATURES = 8  # that a side is told of it
PIXELS = 30, 40  # of its picture
CELL = 256  # parts of a pixel that its places and speeds are counted in


class PongStep(NamedTuple):
    """A step of a game of Pong, one value per lane."""

    reward: torch.Tensor  # (B,): 1 for a point won, -1 for one lost
    reset: torch.Tensor  # (B,) bool, as the next two
    terminal: torch.Tensor
    truncated: torch.Tensor
    points_won: torch.Tensor  # (B,): where a game ends, the share of its points; 0 elsewhere
    features: torch.Tensor | None  # (B, 1, 8) fp16; None where pixels were wanted


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
    """One step of N games of Pong, or, where the last step ended one, the start of another; see
    :class:`~megastep.envs.Pong`. Each serve draws once from the environment's random stream.

    Args: ``games`` (13, N) int32, updated in place, zeros before the first ``restart``, which
    starts all; ``actions`` (B, 1) int64, of one lane per game, or two, the left paddle first: 0
    nothing, 1 up, 2 down; ``error_flag`` (1,) int32, see :func:`check_flag`; ``points`` that win a
    game; ``limit`` steps that truncate it; ``tracker_speed`` cells per step of the right paddle
    where it is no lane; ``pixels`` (B, 1, 1, 30, 40) uint8, written instead of features.
    """
    n, on = checks.length("games", games, axis=1), games.device
    lanes = checks.length("actions", actions)
    if lanes not in (n, 2 * n) or actions.device != on:
        raise ValueError(
            f"actions must be of one lane or two for each of the {n} games on {on}, but those of "
            f"{lanes} lanes on {actions.device} were given"
        )
    flags = [torch.empty(lanes, dtype=torch.bool, device=on) for _ in range(3)]
    reward, points_won = (torch.empty(lanes, device=on) for _ in range(2))
    features, pixels_at = None, 0
    if pixels is None:
        features = torch.empty((lanes, 1, FEATURES), dtype=torch.float16, device=on)
    else:
        pixels_at = checks.address("pixels", pixels, (lanes, 1, 1, *PIXELS), torch.uint8, on)
        if pixels_at % 8:
            raise ValueError("pixels must begin at a multiple of 8 bytes, as a whole tensor does")
    speed = checks.number("tracker_speed", tracker_speed, -math.inf, PIXELS[1], "cells per step")
    if speed < 0:
        raise ValueError(f"tracker_speed must be at least 0 cells per step, not {speed:g}")
    packed = params.PongParams(
        games=checks.address("games", games, (GAME_FIELDS, n), torch.int32, on),
        actions=checks.address("actions", actions, (lanes, 1), torch.int64, on),
        reward=reward.data_ptr(),
        reset=flags[0].data_ptr(),
        terminal=flags[1].data_ptr(),
        truncated=flags[2].data_ptr(),
        points_won=points_won.data_ptr(),
        features=0 if features is None else features.data_ptr(),
        pixels=pixels_at,
        error_flag=checks.address("error_flag", error_flag, (1,), torch.int32, on),
        **seed_params(seed),
        n_envs=n,
        n_sides=lanes // n,
        restart=int(checks.flag("restart", restart)),
        points=checks.integer("points", points, 1, 2**31 - 1),
        limit=checks.integer("limit", limit, 1, 2**31 - 1),
        tracker_speed=round(CELL * speed),
        n_threads=threads(),
    )
    launch("pong", packed, on, threads=n)
    check_flag_on_cpu(error_flag)
    return PongStep(reward, *flags, points_won, features)
