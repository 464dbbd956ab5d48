"""Physics: moving agents, with collisions.

N environments, A agents per environment.
"""

import math

import torch

from megastep.engine import checks
from megastep.engine.agents import Agents, check_on_cpu
from megastep.engine.devices import n_resident_threads
from megastep.engine.launch_params import error_flag_address, lanes_of, scenery_params, state_params
from megastep.engine.objects import object_params
from megastep.engine.outputs import Physics
from megastep.engine.scenery import Scenery
from megastep.kernels.build.launch import ENGINE, launch

__all__ = ["physics"]

#: Threads that move an environment's agents, on a GPU: the most with which all environments move
#: at once, or else the least.
GROUPS = (32, 16, 8)
#: Blocks that a multiprocessor holds, by the bounds of `physics_unspilled`.
UNSPILLED_BLOCKS = 18


def physics(
    scenery: Scenery,
    agents: Agents,
    actions: torch.Tensor | None = None,
    moves: torch.Tensor | None = None,
    damping: float = 1.0,
) -> Physics:
    """Moves the agents by their velocities for 1 / fps seconds, in place.

    An agent stops just before the first wall, agent or solid object that it touches, and its
    velocities become 0.

    Args:
        actions: (N, A) int64, or (N, A, n_moves) float32. If given, velocities are first multiplied
            by ``1 - damping``. An integer then adds one row of ``moves``. Floats, clipped to
            [-1, 1], add all rows, weighted. If None, ``moves`` must be None too.
        moves: (n_moves, 3) m/s ahead, m/s left, deg/s, added by actions.
        damping: fraction of the velocities lost per step.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
        EngineError: on the CPU, if a position or an action is NaN, or an integer action is out of
            range. On a GPU, :func:`~megastep.engine.check` raises it later.
    """
    n, a = lanes = lanes_of(scenery, agents)
    checks.number("damping", damping, -math.inf, math.inf)
    device = scenery.device
    if actions is None and moves is None:
        n_moves = actions_at = controls_at = moves_at = 0
    else:
        n_moves = checks.length("moves", moves)
        if not n_moves:
            raise ValueError("moves must have one row per action, but it has none")
        moves_at = checks.address("moves", moves, (n_moves, 3), torch.float32, device)
        actions_at, controls_at = _addresses(actions, lanes, n_moves, device)
    progress = torch.empty(lanes, device=device)
    kernel = _kernel(n, device)
    if scenery.objects is not None:
        kernel = kernel.replace("physics", "physics_objects")
    threads_per_env = _threads_per_env(n, device)
    launch(
        *(ENGINE, kernel, device, threads_per_env * n),
        scenery=scenery_params(scenery, agents.radius),
        **state_params(scenery, agents, "positions", "angles", "velocity", "angvelocity"),
        progress=progress,
        error_flag=error_flag_address(scenery, agents),
        actions=actions_at,
        controls=controls_at,
        moves=moves_at,
        n_moves=n_moves,
        retained=1 - damping,
        seconds=1 / agents.fps,
        threads_per_env=threads_per_env,
        objects=object_params(scenery),
    )
    check_on_cpu(agents)
    return Physics(progress)


def _addresses(actions, lanes, n_moves, device) -> tuple[int, int]:
    """Returns the addresses of discrete and of continuous actions: one of them is 0."""
    if isinstance(actions, torch.Tensor) and actions.is_floating_point():
        return 0, checks.address("actions", actions, (*lanes, n_moves), torch.float32, device)
    return checks.address("actions", actions, lanes, torch.int64, device), 0


def _kernel(n_envs, device) -> str:
    """Returns the kernel that moves agents: with more registers per thread until environments are
    many, by what is faster on an H200.
    """
    n_threads = GROUPS[-1] * n_envs
    return "physics_unspilled" if n_threads <= n_resident_threads(device) else "physics"


def _threads_per_env(n_envs, device) -> int:
    room = n_resident_threads(device, UNSPILLED_BLOCKS)
    return next((size for size in GROUPS if size * n_envs <= room), GROUPS[-1])
