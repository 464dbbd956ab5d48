"""What environments are made of: movement, sensors, spawning, goals, the lifecycle of episodes.
Callables with a ``.space`` where there is one to declare.
"""

from .goals import goal_fields
from .lanes import to_agents, to_lanes
from .lifecycle import Lifecycle, RandomLifespans, RandomStream
from .movement import MOVES, TURNS, MomentumMovement, SimpleMovement, to_global, to_local
from .sensors import IMU, RGB, Depth, downsample, render
from .spawning import RandomSpawns, spawn_points
from .visibility import TEXELS_PER_POINT, visible_texels

__all__ = [
    "IMU",
    "MOVES",
    "RGB",
    "TEXELS_PER_POINT",
    "TURNS",
    "Depth",
    "Lifecycle",
    "MomentumMovement",
    "RandomLifespans",
    "RandomSpawns",
    "RandomStream",
    "SimpleMovement",
    "downsample",
    "goal_fields",
    "render",
    "spawn_points",
    "to_agents",
    "to_global",
    "to_lanes",
    "to_local",
    "visible_texels",
]
