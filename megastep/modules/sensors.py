"""Sensors: RGB, depth and inertia. A call returns the observation of every agent. Each has a
``space``, the ``state`` of one environment, and ``plot_state``, which draws a numpyified state. N
environments, A agents, C cameras per agent, R rays per camera.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from megastep import engine, plotting, spaces
from megastep.core import Core
from megastep.engine import checks
from megastep.modules.movement import to_local

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from megastep.plotting import Area


def render(core: Core) -> engine.Render:
    """Renders the agents of a core with :func:`megastep.engine.render`."""
    return engine.render(core.scenery, core.agents)


def downsample(screen: torch.Tensor, subsample: int) -> torch.Tensor:
    """Groups rays, (..., R) to (..., R / subsample, subsample). ValueError unless it divides R."""
    n_rays = screen.shape[-1]
    if n_rays % checks.integer("subsample", subsample, 1):
        raise ValueError(f"subsample={subsample} does not divide the {n_rays} rays of the screen")
    return screen.reshape(*screen.shape[:-1], screen.shape[-1] // subsample, subsample)


class _Camera:
    name: str
    n_channels: int

    def __init__(self, core: Core, subsample: int = 1):
        self.core, self.subsample = core, subsample
        downsample(torch.empty(core.res), subsample)
        size = len(core.agents.yaws), core.res // subsample
        self.space = spaces.MultiImage(core.n_agents, self.n_channels, *size, low=0, high=1)

    def __call__(self, r: engine.Render | None = None) -> torch.Tensor:
        """Returns the observation of a render. Default: of the current state."""
        r = render(self.core) if r is None else r
        shape = self.core.n_envs, self.core.n_agents, self.n_channels, -1, self.core.res
        return downsample(self._values(r).reshape(shape), self.subsample).mean(-1)

    def _values(self, r) -> torch.Tensor:
        """Returns what is shown of a render, in the order of (N, A, channels, C, R)."""
        raise NotImplementedError

    def state(self, e: int = 0) -> torch.Tensor:
        """Returns the images of environment ``e``: (A, channels, C, R / subsample)."""
        return self()[e]

    @classmethod
    def plot_state(
        cls,
        state: np.ndarray,
        axes: "Sequence[Area | Axes] | np.ndarray | None" = None,
        yaws: np.ndarray | None = None,
    ) -> np.ndarray:
        """Draws a numpyified :meth:`state` as one strip per agent, with a row per camera, named by
        its yaw, (C,) degrees; depth in grey, bright where near. Returns the axes: those given, one
        per agent, of matplotlib or :func:`megastep.plotting.panels`, or those of a new figure.
        """
        aspect = plotting.STRIP * np.shape(state)[-2]
        return plotting.plot_images({cls.name: state}, aspect=aspect, axes=axes, yaws=yaws)


class RGB(_Camera):
    """RGB images, float32 (N, A, 3, C, R / subsample), in linear light. A pixel is the mean of
    ``subsample`` rays, which divides R.
    """

    name, n_channels = "rgb", 3

    def _values(self, r) -> torch.Tensor:
        screen = r.screen.reshape(self.core.n_envs, self.core.n_agents, -1, self.core.res, 3)
        return screen.permute(0, 1, 4, 2, 3)


class Depth(_Camera):
    """Depth images, float32 (N, A, 1, C, R / subsample). A ray's depth is 1 - clamp((distance -
    radius) / max_depth, 0, 1): 1 at the agent's edge, 0 at ``max_depth`` metres and beyond. A pixel
    is the mean of ``subsample`` rays, which divides R.
    """

    name, n_channels = "depth", 1

    def __init__(self, core: Core, subsample: int = 1, max_depth: float = 10.0):
        super().__init__(core, subsample)
        self.max_depth = max_depth

    def _values(self, r) -> torch.Tensor:
        return 1 - ((r.distances - self.core.agents.radius) / self.max_depth).clamp(0, 1)


class IMU:
    """Inertia, float32 (N, A, 3): angular velocity / 360 deg/s, and velocity / 10 m/s forward and
    left.
    """

    def __init__(self, core: Core):
        self.core = core
        self.space = spaces.MultiVector(core.n_agents, 3)

    def __call__(self) -> torch.Tensor:
        """Returns the observation, (N, A, 3)."""
        agents = self.core.agents
        return torch.cat(
            [agents.angvelocity[..., None] / 360, to_local(agents.angles, agents.velocity) / 10], -1
        )

    def state(self, e: int = 0) -> torch.Tensor:
        """Returns the observation of the agents of environment ``e``: (A, 3)."""
        return self()[e]

    @staticmethod
    def plot_state(state: np.ndarray, ax: "Axes | None" = None) -> "Axes":
        """Draws a numpyified :meth:`state` as three bars per agent. Returns the axes."""
        if ax is None:
            from matplotlib import pyplot

            ax = pyplot.subplots(figsize=(3, 1.5), layout="constrained")[1]
        for a, agent in enumerate(state):
            ax.bar(np.arange(3) + 0.8 * (a + 0.5) / len(state) - 0.4, agent, 0.8 / len(state))
        ax.set_xticks(range(3), ["turn", "ahead", "left"], fontsize="x-small")
        ax.set_ylim(-1, 1)
        return ax
