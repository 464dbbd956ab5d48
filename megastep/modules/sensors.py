"""Sensors: what agents see and feel, one call per observation. Each has a ``.space``, the ``state``
of one environment, and a ``plot_state`` that draws a numpyified one.

N environments, A agents, C cameras per agent, R rays per camera.
"""

from typing import Any

import numpy as np
import torch

from megastep import engine, plotting, spaces
from megastep.modules.movement import to_local


def render(core: Any) -> engine.Render:
    """:func:`~megastep.engine.render` of a core."""
    return engine.render(core.scenery, core.agents)


def downsample(screen: torch.Tensor, subsample: int) -> torch.Tensor:
    """(..., R) to (..., R / subsample, subsample): neighbouring rays grouped, ready for a mean or a
    minimum over the last axis.
    """
    if subsample < 1 or screen.shape[-1] % subsample:
        raise ValueError(
            f"subsample must divide the {screen.shape[-1]} rays of the screen, but {subsample} "
            f"was given"
        )
    return screen.reshape(*screen.shape[:-1], screen.shape[-1] // subsample, subsample)


def _plot_strips(name, state, axes, yaws):
    """Strips of images (A, channels, C, R), one per agent, with a row per camera."""
    aspect = plotting.STRIP * np.shape(state)[-2]
    return plotting.plot_images({name: state}, aspect=aspect, axes=axes, yaws=yaws)


class RGB:
    """Colour: float32 (N, A, 3, 1, R / subsample) in linear light, the mean over ``subsample``
    rays. Several cameras per agent give (N, A, 3, C, R / subsample).
    """

    def __init__(self, core: Any, subsample: int = 1):
        self.core, self.subsample = core, subsample
        downsample(torch.empty(core.res), subsample)
        self.space = spaces.MultiImage(
            core.n_agents, 3, len(core.agents.yaws), core.res // subsample
        )

    def __call__(self, r: engine.Render | None = None) -> torch.Tensor:
        """The observation of a render, by default of one made now."""
        r = render(self.core) if r is None else r
        screen = r.screen.reshape(self.core.n_envs, self.core.n_agents, -1, self.core.res, 3)
        return downsample(screen.permute(0, 1, 4, 2, 3), self.subsample).mean(-1)

    def state(self, e: int = 0) -> torch.Tensor:
        """What the agents of environment ``e`` see now, (A, 3, C, R / subsample)."""
        return self()[e]

    @staticmethod
    def plot_state(state: np.ndarray, axes: Any = None, yaws: Any = None) -> np.ndarray:
        """Draws a numpyified :meth:`state` as strips, one per agent, on as many ``axes`` or on a
        new figure. A strip has a row for each camera, named by its angle if ``yaws`` (C,) are
        given. Returns the axes.
        """
        return _plot_strips("rgb", state, axes, yaws)


class Depth:
    """Depth: float32 (N, A, 1, C, R / subsample), the mean over ``subsample`` rays of 1 -
    clamp((distance - radius) / max_depth, 0, 1); ``max_depth`` metres.
    """

    def __init__(self, core: Any, subsample: int = 1, max_depth: float = 10.0):
        self.core, self.subsample, self.max_depth = core, subsample, max_depth
        downsample(torch.empty(core.res), subsample)
        self.space = spaces.MultiImage(
            core.n_agents, 1, len(core.agents.yaws), core.res // subsample
        )

    def __call__(self, r: engine.Render | None = None) -> torch.Tensor:
        """The observation of a render, by default of one made now."""
        r = render(self.core) if r is None else r
        distances = r.distances.reshape(self.core.n_envs, self.core.n_agents, 1, -1, self.core.res)
        depth = 1 - ((distances - self.core.agents.radius) / self.max_depth).clamp(0, 1)
        return downsample(depth, self.subsample).mean(-1)

    def state(self, e: int = 0) -> torch.Tensor:
        """What the agents of environment ``e`` see now, (A, 1, C, R / subsample)."""
        return self()[e]

    @staticmethod
    def plot_state(state: np.ndarray, axes: Any = None, yaws: Any = None) -> np.ndarray:
        """Draws a numpyified :meth:`state` as :meth:`RGB.plot_state` does, in grey; near is
        bright. Returns the axes.
        """
        return _plot_strips("depth", state, axes, yaws)


class IMU:
    """Inertia: float32 (N, A, 3), angular velocity / 360 and the agent's own velocity, ahead and
    left, / 10.
    """

    def __init__(self, core: Any):
        self.core = core
        self.space = spaces.MultiVector(core.n_agents, 3)

    def __call__(self) -> torch.Tensor:
        agents = self.core.agents
        return torch.cat(
            [agents.angvelocity[..., None] / 360, to_local(agents.angles, agents.velocity) / 10], -1
        )

    def state(self, e: int = 0) -> torch.Tensor:
        """What the agents of environment ``e`` feel now, (A, 3)."""
        return self()[e]

    @staticmethod
    def plot_state(state: np.ndarray, ax: Any = None) -> Any:
        """Draws a numpyified :meth:`state` as three bars per agent, on ``ax`` or on a new figure.
        Returns the axes.
        """
        return plotting.plot_bars(("turn", "ahead", "left"), state, ax)
