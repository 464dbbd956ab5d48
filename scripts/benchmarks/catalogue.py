"""The benchmarks by name, in the order of the table.

Each is a function of a device that yields measurements. Its docstring is printed above the table.
"""

from collections.abc import Callable, Iterator

from adapter_steps import adapters
from engine_operations import agents, cpu, kernels, observe
from env_steps import deathmatch, mazes, memory, objects, pong, step
from populations import members, small_members
from scaling import scaling
from startup_times import startup
from training import train

BENCHMARKS: dict[str, Callable[..., Iterator[dict]]] = {
    "step": step,
    "objects": objects,
    "mazes": mazes,
    "kernels": kernels,
    "observe": observe,
    "agents": agents,
    "deathmatch": deathmatch,
    "memory": memory,
    "adapters": adapters,
    "pong": pong,
    "startup": startup,
    "cpu": cpu,
    "train": train,
    "scaling": scaling,
    "members": members,
    "small_members": small_members,
}
