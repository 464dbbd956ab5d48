"""What environments are made of: movement, sensors, spawning, goals, the lifecycle of episodes.
Callables with a ``.space`` where there is one to declare.
"""

from megastep.modules.lanes import to_agents, to_lanes
from megastep.modules.lifecycle import CounterGenerator, Lifecycle, RandomLifespans
from megastep.modules.movement import (
    MOVES,
    TURNS,
    MomentumMovement,
    SimpleMovement,
    to_global,
    to_local,
)
from megastep.modules.sensors import IMU, RGB, Depth, downsample, render
from megastep.modules.spawning import RandomSpawns, spawn_points
from megastep.modules.visibility import TEXELS_PER_POINT, visible_texels

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
    "CounterGenerator",
    "SimpleMovement",
    "downsample",
    "render",
    "spawn_points",
    "to_agents",
    "to_global",
    "to_lanes",
    "to_local",
    "visible_texels",
]
