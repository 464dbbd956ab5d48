"""The texels of each layout that can be seen from its spawn points. D layouts, P points."""

from pathlib import Path

import torch

from megastep import cache, engine
from megastep.engine import checks
from megastep.engine.scenery import Scenery
from megastep.kernels.build.launch import ENGINE

CAMERAS = (0.0, 120.0, 240.0)  # yaw of each, degrees
FOV = 122.0  # degrees; neighbouring cameras overlap by two
RES = 512  # rays per camera
AWAY = 1e4  # metres; where unused agents stand
PREFIX = "visible-texels-"  # of the files in the cache
MAX_FILES = 256  # in the cache, half a kilobyte per layout: one for each member of a population
MIN_CACHED = 32  # layouts; the computation is quick for fewer
TEXELS_PER_POINT = 64  # newly seen texels that earn a reward of 1


def visible_texels(scenery: Scenery, points: torch.Tensor) -> torch.Tensor:
    """Returns a bitmap, (D, n_words) int32, of the wall texels that are visible from any of the
    layout's points (D, P, 2) with cameras all round. Bits are set as
    :func:`megastep.engine.observe` does. The scenery needs an agent per environment to look round.
    """
    checks.instance("scenery", scenery, Scenery)
    checks.integer("scenery.n_agents", scenery.n_agents, 1)
    layouts, device = scenery.layouts, scenery.device
    points = checks.floats("points", points, (len(layouts), "P", 2), device)
    if device.type != "cpu" or len(layouts) < MIN_CACHED:
        return _visible_from(scenery, points)
    tensors = layouts.lines.vals, layouts.wall_starts, layouts.texel_starts, points
    parts = Path(__file__), ENGINE.sources(".h", ".cpp"), engine.AGENT_RADIUS
    parts = *parts, *(tensor.numpy() for tensor in tensors)
    build = lambda: dict(seen=_visible_from(scenery, points).numpy())  # noqa: E731
    return torch.from_numpy(cache.arrays(PREFIX, parts, build, MAX_FILES)["seen"])


def _visible_from(scenery, points) -> torch.Tensor:
    layouts, device = scenery.layouts, scenery.device
    env_per_layout = Scenery(
        scenery.n_agents,
        layouts,
        scenery.model,
        scenery.model_texels.diff(),
        torch.arange(len(layouts), device=device),
    )
    shape = len(layouts), scenery.n_agents
    agents = engine.Agents(*shape, res=RES, fov=FOV, cameras=CAMERAS, device=device)
    agents.positions.fill_(AWAY)  # agents beside the first must not hide anything
    seen = torch.zeros((*shape, -(-layouts.max_texels // 32)), dtype=torch.int32, device=device)
    for p in range(points.shape[1]):
        agents.positions[:, 0] = points[:, p]
        engine.observe(env_per_layout, agents, rgb=False, depth=False, seen=seen)
    engine.check(agents)
    return seen[:, 0].clone()
