"""The engine: operations on many environments at once, on the device that their tensors are on.

``bake``, ``physics``, ``render``, ``observe``, ``scan``, ``spawn`` and ``uniform`` check their
arguments, allocate their outputs and launch one kernel each. None of them synchronises host and
device. An argument that does not fit raises a TypeError or ValueError that names it; what only the
device can see, such as a NaN position, an EngineError: on the CPU at once, on a GPU by ``check``.
"""

from megastep.devices import device, fit, free_memory, set_threads, threads
from megastep.engine.agents import AGENT_RADIUS, AGENT_WIDTH, MAX_RES, Agents, check, check_flag
from megastep.engine.objects import Objects
from megastep.engine.operations import (
    Physics,
    bake,
    physics,
    place_objects,
    spawn,
    uniform,
    update_objects,
)
from megastep.engine.rendering import (
    Observation,
    Render,
    observe,
    render,
    scan,
    update_agent_geometry,
)
from megastep.engine.resets import Resets
from megastep.engine.scenery import Layouts, Scenery
from megastep.kernels.build.compile import EngineError
from megastep.kernels.build.launch import without_early_starts

__all__ = ["AGENT_RADIUS", "AGENT_WIDTH", "MAX_RES", "Agents", "EngineError", "Layouts", "Objects"]
__all__ += ["Observation", "Physics", "Render", "Resets", "Scenery", "bake", "check", "check_flag"]
__all__ += ["device", "fit", "free_memory", "observe", "physics", "place_objects"]
__all__ += ["render", "scan", "set_threads", "spawn", "threads", "uniform", "update_agent_geometry"]
__all__ += ["update_objects", "without_early_starts"]
