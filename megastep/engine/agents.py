"""Agents: poses, velocities, camera settings, and the errors that the device flagged."""

import math
from collections.abc import Sequence

import torch

from megastep.engine import checks
from megastep.engine.objects import Objects
from megastep.kernels.build.compile import EngineError
from megastep.kernels.build.launch import ENGINE
from megastep.read_only import SetOnce

AGENT_WIDTH = 0.15  # metres, of the square that an agent is drawn as
AGENT_RADIUS = AGENT_WIDTH / 2**0.5  # metres, of the disc around a square of that width
MAX_RES = ENGINE.constants["MAX_RES"]  # rays per camera


class Agents(SetOnce):
    """The agents of N environments, A each, all with the same cameras. Raises ValueError naming the
    argument that is out of range.

    Args:
        n_envs: number of environments N.
        n_agents: agents per environment A.
        res: rays per camera, 1 to 1024.
        fov: field of view in degrees, above 0 and below 180.
        fps: steps per second.
        cameras: yaw offset of each camera in degrees. Default: one camera, straight ahead.
        radius: metres.

    Attributes:
        positions: (N, A, 2) metres. This and the next three may be written in place or replaced.
        angles: (N, A) degrees; 0 looks along +x.
        velocity: (N, A, 2) metres per second.
        angvelocity: (N, A) degrees per second.
        error_flag: (1,) int32, see :func:`check`.
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
        device: torch.device | str = "cpu",
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


_MESSAGES = dict(
    NONFINITE="An agent of environment {env} has a non-finite position, angle or velocity: check "
    "what was last written to them.",
    BAD_ACTION="An agent of environment {env} was given an action outside of its action space: "
    "actions are integers from 0.",
    NAN_ACTION="An agent of environment {env} was given an action that is NaN: continuous actions "
    "are numbers from -1 to 1.",
    NO_LAYOUT="Environment {env} has a grid in which many draws found no room for an object.",
    BAD_LAYOUT="Environment {env} shows a layout that the scenery does not have: entries of "
    "scenery.layout must be from 0 to the number of layouts - 1.",
    BAD_GOAL="An agent of environment {env} has a goal or a spawn point that its layout does not "
    "have: indices must be from 0 to the number per layout - 1.",
)
_OF_OBJECTS = dict(
    BAD_POSE="has a non-finite position or angle, or a size that is not above 0",
    BAD_COLOUR="has a colour that the palette does not have: colours are integers from 0",
    BAD_CARRIER="is carried by an agent that does not exist: carriers are agents, or -1 for none",
    OUTSIDE="is outside of its home",
    NO_ROOM="does not fit anywhere: use fewer or smaller objects, more points, or larger homes",
)


def check(agents: Agents) -> None:
    """Raises the error that the device flagged since the last check, if any. Synchronises host and
    device, so do not call it inside a step. Raises EngineError naming an environment with a
    non-finite position, angle or velocity, with an action that is NaN, or with an action, layout or
    goal that does not exist; or naming an object, and what is wrong with it.
    """
    checked = vars(checks.instance("agents", agents, Agents)).get("_checked")
    check_flag(agents.error_flag, checked and checked.key.objects)  # the last scenery's


def check_flag(error_flag: torch.Tensor, objects: Objects | None = None) -> None:
    """Does what :func:`check` does, for a flag, (1,) int32, which it clears."""
    flag = int(error_flag.item())
    if not flag:
        return
    error_flag.zero_()
    index, number = divmod(flag, ENGINE.constants["ERROR_KINDS"])
    kind = {ENGINE.constants[kind]: kind for kind in (*_MESSAGES, *_OF_OBJECTS)}.get(number)
    if kind in _MESSAGES:
        raise EngineError(_MESSAGES[kind].format(env=index))
    if kind is None or objects is None:
        raise EngineError(f"The error flag holds {flag}, which no kernel writes.")
    env, k = divmod(index, objects.n_objects)
    raise EngineError(f"In environment {env}, {objects.names[k]} {_OF_OBJECTS[kind]}.")
