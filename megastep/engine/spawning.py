"""Spawning agents at random points, and uniform random numbers by lane. Both use the counter-based
generator Philox 4x32-10.

N environments, A agents per environment, D layouts, B lanes.
"""

import torch

from megastep.engine import checks
from megastep.engine.agents import Agents, check_on_cpu
from megastep.engine.devices import threads
from megastep.engine.launch_params import (
    error_flag_address,
    lanes_of,
    scenery_params,
    seed_params,
    state_params,
)
from megastep.engine.objects import object_params
from megastep.engine.scenery import Scenery
from megastep.kernels.build.launch import ENGINE, WARP, launch

__all__ = ["spawn", "uniform"]


def spawn(
    scenery: Scenery,
    agents: Agents,
    mask: torch.Tensor,
    points: torch.Tensor,
    counts: torch.Tensor,
    seed: int,
    resample: bool = False,
    hidden: bool = False,
    point_index: torch.Tensor | None = None,
    cumulative: torch.Tensor | None = None,
) -> None:
    """Puts agents at random points of their environment's layout, at rest, with random headings.

    They drop the objects that they carry, and avoid points on solid objects, unless these were of
    another layout.

    Args:
        mask: (N, A) bool, agents to respawn.
        points: (D, n, 2) metres. Each agent has n / A points of a layout, agent 0 the first ones.
        counts: (N, A) int32, numbers drawn so far. Each respawned agent's is advanced by one.
        seed: the generator's key.
        resample: if all agents of an environment respawn, move it to a random layout first.
        hidden: choose a point that no other agent of the environment sees, except through gaps
            narrower than an agent's radius. If there is none, choose the point that is furthest
            from its nearest agent. Agents respawn one after the other and avoid those before them.
        point_index: (N, A) int32, receives the index of each respawned agent's point.
        cumulative: (D,) int32, cumulative weights of the layouts, by which `resample` draws them:
            whole numbers from 0 whose sum, the last entry, is from 1 to 2**31 - 1. Default: every
            layout is as likely.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
    """
    lanes, device, n_layouts = lanes_of(scenery, agents), scenery.device, len(scenery.layouts)
    n_points = checks.length("points", points, axis=1)
    if n_points < scenery.n_agents:
        raise ValueError(
            f"points must have at least one per agent in each layout, so {scenery.n_agents}, but "
            f"{n_points} were given"
        )
    point_index_at = 0
    if point_index is not None:
        point_index_at = checks.address("point_index", point_index, lanes, torch.int32, device)
    cumulative_at = 0
    if cumulative is not None:
        cumulative_at = checks.address("cumulative", cumulative, (n_layouts,), torch.int32, device)
    is_hidden, n_envs = checks.flag("hidden", hidden), scenery.n_envs
    kernel, n_threads = ("spawn_hidden", WARP * n_envs) if is_hidden else ("spawn", n_envs)
    if scenery.objects is not None:
        kernel += "_objects"
    launch(
        *(ENGINE, kernel, device, n_threads),
        scenery=scenery_params(scenery, agents.radius),
        **state_params(scenery, agents, "positions", "angles", "velocity", "angvelocity"),
        mask=checks.address("mask", mask, lanes, torch.bool, device),
        points=checks.address("points", points, (n_layouts, n_points, 2), torch.float32, device),
        counts=checks.address("counts", counts, lanes, torch.int32, device),
        point_index=point_index_at,
        cumulative=cumulative_at,
        error_flag=error_flag_address(scenery, agents),
        **seed_params(seed),
        n_points=n_points,
        resample=int(checks.flag("resample", resample)),
        objects=object_params(scenery),
    )
    check_on_cpu(agents)


def uniform(counts: torch.Tensor, mask: torch.Tensor, seed: int, out: torch.Tensor) -> torch.Tensor:
    """Draws four uniform numbers in [0, 1) for each masked lane.

    Args:
        counts: (B,) int32, numbers drawn so far: with the lane, the generator's counter. Advanced
            by one where ``mask``.
        mask: (B,) bool, lanes that draw.
        seed: the generator's key.
        out: (B, 4) float32, written where ``mask``.

    Returns:
        ``out``.
    """
    n, device = checks.length("counts", counts), counts.device
    launch(
        *(ENGINE, "uniform", device, n),
        counts=checks.address("counts", counts, (n,), torch.int32, device),
        mask=checks.address("mask", mask, (n,), torch.bool, device),
        out=checks.address("out", out, (n, 4), torch.float32, device),
        **seed_params(seed),
        n_lanes=n,
        n_threads=threads(),
    )
    counts.add_(mask)
    return out
