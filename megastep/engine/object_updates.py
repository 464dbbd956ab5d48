"""Moving objects to their carriers, drawing them, and putting them at random points.

N environments, O objects per environment, D layouts.
"""

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
from megastep.kernels.build.launch import ENGINE, launch

__all__ = ["place_objects", "update_objects"]

APART = 0.05  # metres


def update_objects(scenery: Scenery, agents: Agents) -> None:
    """Moves carried objects to their carriers, and writes all objects' lines and texels. Does
    nothing if the scenery has no objects. :func:`render` and :func:`observe` do this first.
    """
    n, _ = lanes_of(scenery, agents)
    if scenery.objects is None:
        return
    launch(
        *(ENGINE, "update_objects", scenery.device, n * scenery.objects.n_objects),
        scenery=scenery_params(scenery, agents.radius),
        objects=object_params(scenery),
        **state_params(scenery, agents, "positions", "angles"),
    )
    check_on_cpu(agents)


def place_objects(
    scenery: Scenery,
    agents: Agents,
    mask: torch.Tensor,
    points: torch.Tensor,
    counts: torch.Tensor,
    seed: int,
    apart: float = APART,
) -> None:
    """Puts objects at random points of their environment's layout, visible, carried by nobody, at
    random angles.

    Each is put at the first point that fits, counted from a random one: agents and visible objects
    are at least ``apart`` from it. Crates and doors count as discs of their size. Objects that are
    placed by the same call do not keep clear of each other's old positions.

    Args:
        mask: (N, O) bool, objects to place.
        points: (D, n, 2) metres.
        counts: (N, O) int32, numbers drawn so far. Each placed object's is advanced by one.
        seed: the generator's key.
        apart: metres.

    Raises:
        TypeError, ValueError: naming the argument that does not fit.
        EngineError: on the CPU, if an object fits nowhere; on a GPU, :func:`check` raises it later.
    """
    lanes_of(scenery, agents)
    if scenery.objects is None:
        raise ValueError("scenery has no objects: set scenery.objects = engine.Objects(...) first")
    device, shape = scenery.device, (scenery.n_envs, scenery.objects.n_objects)
    n_points = checks.length("points", points, axis=1)
    checks.integer("the number of points per layout", n_points, 1)
    points_shape = len(scenery.layouts), n_points, 2
    launch(
        *(ENGINE, "place_objects", device, scenery.n_envs),
        scenery=scenery_params(scenery, agents.radius),
        objects=object_params(scenery),
        agents=state_params(scenery, agents, "positions")["positions"],
        mask=checks.address("mask", mask, shape, torch.bool, device),
        points=checks.address("points", points, points_shape, torch.float32, device),
        counts=checks.address("counts", counts, shape, torch.int32, device),
        error_flag=error_flag_address(scenery, agents),
        **seed_params(seed),
        n_points=n_points,
        apart=checks.number("apart", apart, -1, checks.LIMIT, "metres"),
    )
    check_on_cpu(agents)
