"""One step of Keys as one operation.

N environments of one agent, D layouts, M episodes per layout, C colours, K doorways.
"""

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

__all__ = ["LIBRARY", "KeysStep", "keys_step"]

LIBRARY = KernelLibrary(Path(__file__).parent / "kernels")
N_METRICS = LIBRARY.constants["N_METRICS"]


class KeysStep(NamedTuple):
    """The outcome of a step, one row per environment."""

    reward: torch.Tensor  # (N,)
    reset: torch.Tensor  # (N,) bool
    terminal: torch.Tensor  # (N,) bool
    truncated: torch.Tensor  # (N,) bool
    metrics: torch.Tensor  # (3, N): success, doors opened, keys wasted, where an episode ends
    keys_obs: torch.Tensor  # (N, 1, C) fp16: 1 for each key that the agent carries
    privileged: torch.Tensor | None  # (N, 1, 2 C + 3) for a critic: tens of metres ahead and to the
    # left to each key that lies about and to the goal; fraction of the steps that is left


def keys_step(
    scenery: Scenery,
    agents: Agents,
    starts: torch.Tensor,
    keys: torch.Tensor,
    goals: torch.Tensor,
    doors: torch.Tensor,
    doorways: torch.Tensor,
    opened: torch.Tensor,
    n_draws: torch.Tensor,
    ages: torch.Tensor,
    ended: torch.Tensor,
    *,
    seed: int = 1,
    limit: int = 1000,
    reach: float = 0.05,
    key_reward: float | torch.Tensor = 0.0,
    door_reward: float | torch.Tensor = 0.0,
    privileged: bool = False,
) -> KeysStep:
    """Has each agent pick up the keys and open the doors that it touches, and ends its episode at
    the goal. Where an episode starts, puts agent and objects where a random one of the layout's
    episodes has them. Call it before the environment is rendered. See
    :class:`~megastep.envs.Keys`.

    Args:
        scenery: whose objects are C keys, the goal, and K doors.
        starts: (D, M, 2) float32 metres, where agents begin.
        keys: (D, M, C, 2) float32 metres, NaN of a key that there is not.
        goals: (D, M, 2) float32 metres.
        doors: (D, M, K) int32: -1 for no door, the colour of a door, or C for one that stays
            locked.
        doorways: (D, K, 4) float32: x and y in metres, angle in degrees, half the length in metres.
        opened: (N,) int32, doors opened in this episode, updated in place as all that follow.
        n_draws: (N,) int32, numbers drawn so far, the generator's counter.
        ages: (N,) int32, steps since the first observation.
        ended: (N,) bool. In: environments that start an episode in this step. Out: those whose
            episode ends in this step.
        seed: the generator's key.
        limit: steps after which an episode is truncated.
        reach: metres between surfaces at which an agent touches an object.
        key_reward: for a key that is picked up; a number, or a tensor () on the device.
        door_reward: for a door that is opened, likewise.
        privileged: compute the privileged observation.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
        EngineError: on the CPU, if a position is NaN.
    """
    n, _ = lanes_of(scenery, agents)
    checks.integer("agents per environment", scenery.n_agents, 1, 1)
    device, d, m = scenery.device, len(scenery.layouts), checks.length("starts", starts, axis=1)
    n_colours, n_doorways = checks.length("keys", keys, 2), checks.length("doors", doors, 2)
    objects = scenery.objects
    n_objects = objects.n_objects if objects is not None else 0
    checks.integer("objects", n_objects, n_colours + 1 + n_doorways, n_colours + 1 + n_doorways)
    flags = [torch.empty(n, dtype=torch.bool, device=device) for _ in range(3)]
    privileged_out = None
    if checks.flag("privileged", privileged):
        privileged_out = torch.empty((n, 1, 2 * n_colours + 3), device=device)
    out = KeysStep(
        torch.empty(n, device=device),
        *flags,
        metrics=torch.empty((N_METRICS, n), device=device),
        keys_obs=torch.empty((n, 1, n_colours), dtype=torch.float16, device=device),
        privileged=privileged_out,
    )
    tables = dict(
        starts=(starts, (d, m, 2)),
        keys=(keys, (d, m, n_colours, 2)),
        goals=(goals, (d, m, 2)),
        doorways=(doorways, (d, n_doorways, 4)),
    )
    counters = dict(opened=opened, n_draws=n_draws, ages=ages)
    launch(
        *(LIBRARY, "keys_step", device, n),
        scenery=scenery_params(scenery, agents.radius),
        objects=object_params(scenery),
        **state_params(scenery, agents, "positions", "angles"),
        **{
            name: checks.address(name, tensor, shape, torch.float32, device)
            for name, (tensor, shape) in tables.items()
        },
        doors=checks.address("doors", doors, (d, m, n_doorways), torch.int32, device),
        **{
            name: checks.address(name, tensor, (n,), torch.int32, device)
            for name, tensor in counters.items()
        },
        ended=checks.address("ended", ended, (n,), torch.bool, device),
        error_flag=error_flag_address(scenery, agents),
        **out._asdict(),
        **seed_params(seed),
        n_episodes=m,
        n_colours=n_colours,
        n_doorways=n_doorways,
        limit=checks.integer("limit", limit, 1, 2**31 - 1),
        reach=checks.number("reach", reach, 0, checks.LIMIT, "metres"),
        key_reward=checks.weight("key_reward", key_reward, device),
        door_reward=checks.weight("door_reward", door_reward, device),
    )
    check_on_cpu(agents)
    return out
