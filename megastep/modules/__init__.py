"""The parts of an environment: movement, sensors, spawning, episodes, lanes. They are callables.
Sensors and movements have a ``.space``.
"""

from megastep.modules.lifecycle import (
    ENDLESS,
    CounterGenerator,
    Lifecycle,
    RandomLifespans,
    random_ages,
)
from megastep.modules.movement import (
    MOVES,
    TURNS,
    MomentumMovement,
    SimpleMovement,
    to_agents,
    to_global,
    to_lanes,
    to_local,
)
from megastep.modules.objects import COLOURS, Crate, Disc, Door, Objects, Ramp, doorways
from megastep.modules.robots import DifferentialMovement, Lidar, Robot
from megastep.modules.sensors import IMU, RGB, Depth, downsample, render
from megastep.modules.spawning import FreePoints, RandomSpawns, spawn_points
from megastep.modules.visibility import TEXELS_PER_POINT, visible_texels

__all__ = ["COLOURS", "ENDLESS", "IMU", "MOVES", "RGB", "TEXELS_PER_POINT", "TURNS", "Crate"]
__all__ += ["Depth", "Disc", "Door", "FreePoints", "Lifecycle", "MomentumMovement", "Objects"]
__all__ += ["RandomLifespans", "RandomSpawns", "CounterGenerator", "SimpleMovement", "doorways"]
__all__ += ["downsample", "random_ages", "render", "spawn_points", "to_agents", "to_global"]
__all__ += ["to_lanes", "to_local", "visible_texels", "DifferentialMovement", "Lidar", "Ramp"]
__all__ += ["Robot"]
