"""Which of a layout's texels can be seen at all: the most that a view may show.

D layouts, P points, N environments.
"""

import torch

from .. import checks, engine
from ..scenery import Scenery

__all__ = ["visible_texels"]

CAMERAS = (0.0, 120.0, 240.0)  # degrees
FOV = 122.0  # degrees; neighbouring cameras overlap by two
RES = 512  # rays per camera
AWAY = 1e4  # metres


def visible_texels(scenery: Scenery, points: torch.Tensor) -> torch.Tensor:
    """(D, n_words) int32, a bit for each static texel of each layout: whether it is seen by a look
    all round from one of the layout's ``points`` (D, P, 2), as :func:`~megastep.engine.observe`
    marks what is seen. ValueError if the scenery has no agent to look with.
    """
    checks.instance("scenery", scenery, Scenery)
    checks.integer("scenery.n_agents", scenery.n_agents, 1)
    layouts, device = scenery.layouts, scenery.device
    points = checks.floats("points", points, (len(layouts), "P", 2), device)
    each_once = Scenery.of_layouts(
        scenery.n_agents,
        layouts,
        scenery.model,
        scenery.model_texels.diff(),
        torch.arange(len(layouts), device=device),
    )
    shape = len(layouts), scenery.n_agents
    agents = engine.Agents(*shape, res=RES, fov=FOV, cameras=CAMERAS, device=device)
    agents.positions.fill_(AWAY)  # all agents but the first, which shall not hide anything
    seen = torch.zeros((*shape, -(-layouts.max_texels // 32)), dtype=torch.int32, device=device)
    for p in range(points.shape[1]):
        agents.positions[:, 0] = points[:, p]
        engine.observe(each_once, agents, rgb=False, depth=False, seen=seen)
    engine.check(agents)
    return seen[:, 0].clone()
