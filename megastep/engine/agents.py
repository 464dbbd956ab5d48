"""Agents: where they are, how they move, what their cameras are like, and what the device found
wrong with them.
"""

import math
from collections.abc import Sequence
from typing import Any

import torch

from megastep.engine import checks
from megastep.kernels.build.compile import EngineError
from megastep.read_only import SetOnce

__all__ = [
    *("AGENT_RADIUS", "AGENT_WIDTH", "MAX_RES", "Agents"),
    *("check", "check_flag", "check_on_cpu", "check_flag_on_cpu"),
]

AGENT_WIDTH = 0.15
AGENT_RADIUS = AGENT_WIDTH / 2**0.5  # the disc about a square of that width
MAX_RES = 1024


class Agents(SetOnce):
    """A agents in each of N environments, their cameras alike.

    ``positions`` (N, A, 2) metres, ``angles`` (N, A) degrees, ``velocity`` (N, A, 2) metres per
    second, ``angvelocity`` (N, A) degrees per second; an angle of 0 looks along +x. They may be
    written in place or replaced. The settings are fixed: ``res`` rays per camera, ``fov`` degrees,
    ``fps`` steps per second, ``radius`` metres, and ``cameras``, yaw offsets in degrees, of which
    there is one straight ahead by default.

    ValueError unless 1 <= res <= 1024, 0 < fov < 180, fps > 0, radius > 0.
    """

    _replaceable = ("positions", "angles", "velocity", "angvelocity")

    def __init__(
        self,
        n_envs: int,
        n_agents: int,
        res: int = 64,
        fov: float = 130.0,
        fps: float = 10.0,
        cameras: Sequence[float] | None = None,
        radius: float = AGENT_RADIUS,
        device: Any = "cpu",
    ):
        device = checks.device("device", device)
        n_envs = checks.integer("n_envs", n_envs, 1)
        n_agents = checks.integer("n_agents", n_agents, 0)
        self.res = checks.integer("res", res, 1, MAX_RES)
        self.fov = checks.number(
            "fov", fov, 0, 180, "degrees", hint=" (a wider view takes several cameras)"
        )
        self.fps = checks.number("fps", fps, 0, math.inf, "steps per second")
        self.radius = checks.number("radius", radius, 0, math.inf, "metres")
        yaws = checks.floats("cameras", [0.0] if cameras is None else cameras, ("C",), device)
        if not len(yaws):
            raise ValueError("cameras must hold at least one yaw, but an empty list was given")
        self.n_cameras, self.yaws = len(yaws), yaws
        half_width = math.tan(math.radians(self.fov / 2))
        sideways = half_width * (1 - (2 * torch.arange(res, dtype=torch.float64) + 1) / res)
        self.ray_lengths = (1 + sideways**2).sqrt().float().to(device)  # (R,), per unit of depth
        self.positions = torch.zeros((n_envs, n_agents, 2), device=device)
        self.angles = torch.zeros((n_envs, n_agents), device=device)
        self.velocity = torch.zeros((n_envs, n_agents, 2), device=device)
        self.angvelocity = torch.zeros((n_envs, n_agents), device=device)
        self.error_flag = torch.zeros(1, dtype=torch.int32, device=device)


# By kind, as errors.h numbers them.
_ERRORS = {
    1: "An agent of environment {env} has a position, angle or velocity that is not a finite "
    "number: look at what was last written to it.",
    2: "An agent of environment {env} was given an action that is none of its action space: "
    "actions count from 0.",
    3: "Environment {env} shows a layout that the scenery does not have: ids in scenery.layout "
    "count from 0 and stay below the number of layouts.",
    4: "An agent of environment {env} has a goal or a spawn point that its layout does not have: "
    "they count from 0 and stay below their number per layout.",
}
_KINDS = 8  # as errors.h has it


def check(agents: Agents) -> None:
    """EngineError, which names an environment, if since the last check an agent's position, angle
    or velocity was not a finite number, an action, a layout or a goal was none. Synchronises
    with the device, so it is not for inside a step.
    """
    check_flag(checks.instance("agents", agents, Agents).error_flag)


def check_flag(error_flag: torch.Tensor) -> None:
    """:func:`check` of a flag (1,) int32 that is no agents'."""
    flag = int(error_flag)
    if flag:
        error_flag.zero_()
        env, kind = divmod(flag, _KINDS)
        raise EngineError(_ERRORS[kind].format(env=env))


def check_on_cpu(agents: Agents) -> None:
    """:func:`check` where it takes no synchronisation."""
    check_flag_on_cpu(agents.error_flag)


def check_flag_on_cpu(error_flag: torch.Tensor) -> None:
    """:func:`check_flag` where it takes no synchronisation."""
    if error_flag.device.type == "cpu":
        check_flag(error_flag)
