"""The engine: operations on many environments at once, on the CPU or the GPU, whichever their tensors
are on.

``bake``, ``physics``, ``render``, ``observe``, ``unseen``, ``coverage``, ``spawn`` and ``uniform``
check their arguments, allocate their outputs and launch one kernel each. None synchronises host and
device. An argument that does not fit raises TypeError or ValueError and is named.

A game's step is an operation too; it lies beside its environment, such as
:func:`megastep.envs.deathmatch.step.deathmatch_step`.
"""

from megastep.engine.agents import AGENT_RADIUS, AGENT_WIDTH, MAX_RES, Agents, check, check_flag
from megastep.engine.devices import device, fit, set_threads, threads
from megastep.engine.ops import (
    BANDS,
    SECTORS,
    bake,
    coverage,
    observe,
    physics,
    render,
    spawn,
    uniform,
    unseen,
    update_agent_geometry,
)
from megastep.engine.outputs import Observation, Physics, Render
from megastep.engine.scenery import Layouts, Scenery
from megastep.kernels.build.compile import EngineError

__all__ = [
    "AGENT_RADIUS",
    "AGENT_WIDTH",
    "BANDS",
    "MAX_RES",
    "SECTORS",
    "Agents",
    "EngineError",
    "Layouts",
    "Observation",
    "Physics",
    "Render",
    "Scenery",
    "bake",
    "check",
    "check_flag",
    "coverage",
    "device",
    "fit",
    "observe",
    "physics",
    "render",
    "set_threads",
    "spawn",
    "threads",
    "uniform",
    "unseen",
    "update_agent_geometry",
]
