"""The benchmarks by name, in the order of the table.

Each is a function of a device that yields measurements. Its docstring is printed above the table.
"""

from collections.abc import Callable, Iterator

from adapter_steps import adapters
from engine_operations import agents, cpu, kernels, observe
from env_steps import deathmatch, hideandseek, mazes, memory, objects, pong, step
from learning import grids, ppo
from populations import members, small_members
from scaling import scaling
from training import startup, train

ALL = (
    step,
    objects,
    hideandseek,
    mazes,
    kernels,
    observe,
    agents,
    deathmatch,
    memory,
    adapters,
    pong,
    grids,
    ppo,
    startup,
)
ALL += (cpu, train, scaling, members, small_members)
BENCHMARKS: dict[str, Callable[..., Iterator[dict]]] = {one.__name__: one for one in ALL}
