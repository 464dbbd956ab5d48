"""Random points where an agent fits. N environments, K points each, D layouts."""

from collections.abc import Sequence

import torch

from megastep.core import Core
from megastep.dotdict import dotdict
from megastep.engine import checks
from megastep.modules.lifecycle import CounterGenerator, derived_seed
from megastep.modules.spawning import MAX_SPAWNS, cached_points


class FreePoints:
    """Draws random points in the rooms of environments' homes, such as goals or places for objects.

    A disc of an agent's radius around each point is 5 cm clear of every wall. A point is drawn in
    the layout that the environment shows at the call, so call it after the spawner. The k-th draw
    is the same on the CPU, on a GPU and in a CUDA graph; a call does not synchronise.

    Args:
        geometries: those that the scenery was made from.
        core: the environment's core.
        n_points: points per layout to draw from.
        per_env: points drawn per environment, K. Default: one per agent.
        seed: of the points and draws. Default: the core's. Two instances with equal seeds draw
            equal points.

    Attributes:
        points: (D, n_points, 2) float32 metres, the points of each layout.

    Raises:
        ValueError: if a geometry has no point where an agent fits, there are fewer geometries than
            layouts, or a number is below 1.
    """

    def __init__(
        self,
        geometries: Sequence[dotdict],
        core: Core,
        n_points: int = 128,
        per_env: int | None = None,
        seed: int | None = None,
    ):
        per_env = core.n_agents if per_env is None else per_env
        self.core, self.per_env = core, checks.integer("per_env", per_env, 1)
        n_points = checks.integer("n_points", n_points, 1, MAX_SPAWNS)
        seed = core.seed if seed is None else checks.integer("seed", seed, 0)
        seed = derived_seed(seed, "points")
        n_layouts = len(core.scenery.layouts)
        if len(geometries) < n_layouts:
            raise ValueError(
                f"geometries must be those that the scenery was made from, one for each of its "
                f"{n_layouts} layouts, but {len(geometries)} were given"
            )
        geometries = geometries[:n_layouts]
        points = cached_points(geometries, n_points, 1, core.agents.radius, seed)
        self.points = torch.as_tensor(points, device=core.device)
        self.generator = CounterGenerator(core.n_envs * self.per_env, seed, core.device)

    def __call__(self, mask: torch.Tensor) -> torch.Tensor:
        """Draws new points where ``mask``, (N, K) or (N * K,) bool, is True.

        Returns (N, K, 2) float32 metres. Elsewhere these are the points of the last draw. If the
        environment has moved to another layout since, they are arbitrary points of that one.
        """
        n_points = self.points.shape[1]
        index = (self.generator(mask)[:, 0] * n_points).long().view(-1, self.per_env)
        rows = self.core.scenery.layout.long()[:, None] * n_points + index
        return self.points.flatten(0, 1)[rows]
