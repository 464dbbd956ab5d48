"""One step of Memory as one operation. N environments of one agent, D layouts, O objects."""

from pathlib import Path
from typing import NamedTuple

import torch

from megastep.engine import checks
from megastep.engine.agents import Agents, check_on_cpu
from megastep.engine.launch_params import (
    error_flag_address,
    lanes_of,
    scenery_params,
    seed_params,
    state_params,
)
from megastep.engine.objects import object_params
from megastep.engine.scenery import Scenery
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import launch

__all__ = ["LIBRARY", "N_GOAL", "MemoryStep", "memory_step"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
N_GOAL = LIBRARY.constants["N_GOAL"]  # numbers that a critic sees of the object to find


class MemoryStep(NamedTuple):
    """The outcome of a step, one row per environment."""

    reward: torch.Tensor  # (N,) 1 where the object to find was touched, else 0
    reset: torch.Tensor  # (N,) bool
    terminal: torch.Tensor  # (N,) bool, always False
    truncated: torch.Tensor  # (N,) bool
    metrics: torch.Tensor  # (N,) objects found where an episode ends
    cue_obs: torch.Tensor  # (N, 1, 3) fp16, linear light: the colour of the object to find
    goal: (
        torch.Tensor | None
    )  # (N, 1, 4) for a critic: tens of metres to the object to find: ahead,
    # to the left and in a straight line; fraction of the steps that is left. None if not wanted
    places: torch.Tensor | None  # (N, 1, 2 O) tens of metres ahead and to the left to each object


def memory_step(
    scenery: Scenery,
    agents: Agents,
    arrangements: torch.Tensor,
    cue: torch.Tensor,
    found: torch.Tensor,
    n_draws: torch.Tensor,
    ages: torch.Tensor,
    ended: torch.Tensor,
    *,
    seed: int = 1,
    limit: int = 1000,
    reach: float = 0.05,
    privileged: bool = False,
) -> MemoryStep:
    """Rewards each agent that touches the object to find, and draws the next among the others.
    Where an episode starts, puts objects where a random arrangement has them. Call it before the
    environment is rendered. See :class:`~megastep.envs.Memory`.

    Args:
        scenery: with two objects or more.
        arrangements: (D, M, O, 2) float32 metres, where objects may lie.
        cue: (N,) int32, the object to find, updated in place as all that follow.
        found: (N,) int32, objects found in this episode.
        n_draws: (N,) int32, numbers drawn so far, the generator's counter.
        ages: (N,) int32, steps since the first observation.
        ended: (N,) bool. In: environments that start an episode in this step. Out: those whose
            episode ends in this step.
        seed: the generator's key.
        limit: steps after which an episode is truncated.
        reach: metres between surfaces at which an agent touches an object.
        privileged: compute the privileged observation.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
        EngineError: on the CPU, if a position is NaN or an object to find does not exist.
    """
    n, _ = lanes_of(scenery, agents)
    checks.integer("agents per environment", scenery.n_agents, 1, 1)
    objects, device = scenery.objects, scenery.device
    n_objects = checks.integer("objects", objects.n_objects if objects is not None else 0, 2)
    n_arrangements = checks.length("arrangements", arrangements, axis=1)
    flags = [torch.empty(n, dtype=torch.bool, device=device) for _ in range(3)]
    goal = places = None
    if checks.flag("privileged", privileged):
        goal = torch.empty((n, 1, N_GOAL), device=device)
        places = torch.empty((n, 1, 2 * n_objects), device=device)
    out = MemoryStep(
        torch.empty(n, device=device),
        *flags,
        metrics=torch.empty(n, device=device),
        cue_obs=torch.empty((n, 1, 3), dtype=torch.float16, device=device),
        goal=goal,
        places=places,
    )
    counters = dict(cue=cue, found=found, n_draws=n_draws, ages=ages)
    shape = len(scenery.layouts), n_arrangements, n_objects, 2
    launch(
        *(LIBRARY, "memory_step", device, n),
        scenery=scenery_params(scenery, agents.radius),
        objects=object_params(scenery),
        **state_params(scenery, agents, "positions", "angles"),
        arrangements=checks.address("arrangements", arrangements, shape, torch.float32, device),
        **{
            name: checks.address(name, tensor, (n,), torch.int32, device)
            for name, tensor in counters.items()
        },
        ended=checks.address("ended", ended, (n,), torch.bool, device),
        error_flag=error_flag_address(scenery, agents),
        **out._asdict(),
        **seed_params(seed),
        n_arrangements=checks.integer("the number of arrangements", n_arrangements, 1),
        limit=checks.integer("limit", limit, 1, 2**31 - 1),
        reach=checks.number("reach", reach, 0, checks.LIMIT, "metres"),
    )
    check_on_cpu(agents)
    return out
