"""The benchmarks by name, in the order of the table.

Each is a function of a device that yields measurements. Its docstring is printed above the table.
"""

from collections.abc import Callable, Iterator

from adapter_steps import adapters
from checkpoints import checkpoints
from engine_operations import agents, cpu, kernels, observe
from env_steps import deathmatch, mazes, memory, objects, pong, step
from exported_agents import exported, pages
from films import films
from libraries import libraries
from nsight_counters import counters
from peers import peers
from plan_statistics import plans
from population_benchmarks import copies, league, members, memory_search, search, small_members
from published import published
from replay_buffer import replay
from scaling import ranks, scaling
from shortest_paths import paths
from startup_times import compile_kernels, first_step, startup
from training_benchmarks import ablation, curricula, duels, learners, train, worlds

BENCHMARKS: dict[str, Callable[..., Iterator[dict]]] = {
    "step": step,
    "objects": objects,
    "mazes": mazes,
    "kernels": kernels,
    "counters": counters,
    "observe": observe,
    "agents": agents,
    "deathmatch": deathmatch,
    "memory": memory,
    "adapters": adapters,
    "libraries": libraries,
    "replay": replay,
    "pong": pong,
    "paths": paths,
    "plans": plans,
    "checkpoints": checkpoints,
    "films": films,
    "exported": exported,
    "pages": pages,
    "compile": compile_kernels,
    "first": first_step,
    "startup": startup,
    "cpu": cpu,
    "train": train,
    "worlds": worlds,
    "duels": duels,
    "ablation": ablation,
    "learners": learners,
    "curricula": curricula,
    "published": published,
    "peers": peers,
    "scaling": scaling,
    "ranks": ranks,
    "members": members,
    "small_members": small_members,
    "copies": copies,
    "search": search,
    "memory_search": memory_search,
    "league": league,
}
