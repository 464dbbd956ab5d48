"""Which of a layout's texels can be seen at all: the most that a view may show.

D layouts, P points, N environments.
"""

import hashlib
from pathlib import Path

import numpy as np
import torch

from megastep import cache, engine
from megastep.engine import checks
from megastep.engine.scenery import Scenery
from megastep.kernels.build.launch import ENGINE

__all__ = ["visible_texels"]

CAMERAS = (0.0, 120.0, 240.0)  # degrees
FOV = 122.0  # degrees; neighbouring cameras overlap by two
RES = 512  # rays per camera
AWAY = 1e4  # metres
PREFIX = "visible-texels-"  # of their files in the cache
MAX_FILES = 32  # of them, half a kilobyte per layout
MIN_CACHED = 32  # layouts; the texels of fewer are found in no time
TEXELS_PER_POINT = 64  # newly seen texels that earn a reward of 1


def visible_texels(scenery: Scenery, points: torch.Tensor) -> torch.Tensor:
    """(D, n_words) int32, a bit for each static texel of each layout: whether it is seen by a look
    all round from one of the layout's ``points`` (D, P, 2), as :func:`~megastep.engine.observe`
    marks what is seen. ValueError if the scenery has no agent to look with.

    On the CPU, where two thousand homes take seconds, many layouts' are kept in the cache.
    """
    checks.instance("scenery", scenery, Scenery)
    checks.integer("scenery.n_agents", scenery.n_agents, 1)
    layouts, device = scenery.layouts, scenery.device
    points = checks.floats("points", points, (len(layouts), "P", 2), device)
    if device.type != "cpu" or len(layouts) < MIN_CACHED:
        return _looked(scenery, points)
    key = hashlib.sha256(Path(__file__).read_bytes() + repr(engine.AGENT_RADIUS).encode())
    for name, text in ENGINE.sources(".h", ".cpp").items():
        key.update(f"{name}\0{text}\0".encode())
    for tensor in (layouts.lines.vals, layouts.wall_starts, layouts.texel_starts, points):
        key.update(repr((tensor.shape, tensor.dtype)).encode() + tensor.numpy().tobytes())

    def build():
        cache.prune(PREFIX, MAX_FILES - 1)
        return _looked(scenery, points).numpy().tobytes()

    body, _ = cache.fetch(f"{PREFIX}{key.hexdigest()[:20]}", build)
    return torch.from_numpy(np.frombuffer(body, np.int32).reshape(len(layouts), -1).copy())


def _looked(scenery, points):
    layouts, device = scenery.layouts, scenery.device
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
