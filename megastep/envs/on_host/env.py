"""VectorizedEnv: a vector environment that steps on the host, with the interface learners use.

N environments of A agents each, B = N A lanes.
"""

import functools
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from megastep import engine
from megastep.arrdict import arrdict
from megastep.env_state import EnvState
from megastep.envs.on_host.buffers import HostBuffers
from megastep.envs.on_host.spaces import actions, observation
from megastep.vector_processes import VectorProcesses, start_rendering

__all__ = ["VectorizedEnv"]


class VectorizedEnv:
    """Wraps a vector environment that resets a lane in the step after its episode's end.

    Args:
        id: name of the environments in messages.
        vector: has ``single_observation_space``, ``single_action_space``, ``metadata``,
            ``render_mode``, ``reset(seed=)``, ``step(actions)``, ``render()`` and ``close()``, as
            Gymnasium's vector environments do, with a row per lane.
        n_envs: number of environments, N.
        n_agents: lanes per environment, A.
        seeds: passed to the first ``vector.reset``, one per environment or one for all.
        device: where worlds and actions are. Default: a GPU if there is one.

    Raises:
        ValueError: if a space has no conversion, with its name and the cure.
    """

    capturable = False

    def __init__(
        self,
        id: str | None,
        vector: Any,
        n_envs: int,
        n_agents: int,
        seeds: list[int] | int,
        device: torch.device | str | None,
    ):
        self.id, self.vector, self.n_envs, self.n_agents = id, vector, n_envs, n_agents
        self.device = engine.device("auto" if device is None else device)
        self._seeds = seeds
        self.fps = float(vector.metadata.get("render_fps") or 10)
        try:
            self.obs_space, self._read = observation(vector.single_observation_space)
            self.action_space, self._write = actions(vector.single_action_space)
        except ValueError as error:
            self.close()
            raise ValueError(f"{id}: {error}") from None
        n_lanes = n_envs * n_agents
        self._buffers = HostBuffers(n_lanes, self.obs_space, self.action_space, self.device)
        self._ended = np.ones(n_lanes, bool)

    def reset(self) -> arrdict:
        """Starts a new episode in every lane. Returns the first world."""
        obs, _ = self.vector.reset(seed=self._seeds)
        self._seeds = None
        self._ended[:] = True
        return self._world(obs, np.zeros(len(self._ended)), self._ended, self._ended)

    def step(self, decision: Mapping) -> arrdict:
        """Takes one step by ``decision["actions"]``. Returns a world."""
        actions = self._write(self._buffers.receive(decision["actions"]))
        obs, reward, terminated, truncated, _ = self.vector.step(actions)
        return self._world(obs, reward, terminated, truncated)

    @functools.cached_property
    def resumable(self) -> bool:
        """False if checkpoints cannot hold the environments: those in other processes, and those
        whose state is not in Python, such as Box2D's.
        """
        is_here = not isinstance(self.vector, VectorProcesses)
        return is_here and not EnvState(self).unreachable()

    def close(self) -> None:
        """Closes the environments, and ends their processes."""
        self.vector.close()

    def state(self, e: int = 0) -> arrdict:
        """Returns the frame of environment ``e``, (H, W, 3) uint8, as the environment renders it.

        Raises:
            ValueError: if it renders no images.
        """
        start_rendering(self.vector)
        if self.vector.render_mode != "rgb_array":
            raise ValueError(
                f"{self.id} renders no images: it has no render mode rgb_array, or env.kwargs "
                "chooses another"
            )
        return arrdict(frame=torch.from_numpy(np.array(self.vector.render()[e])))

    @staticmethod
    def plot_state(state: arrdict) -> np.ndarray:
        """Returns the frame of a numpyified :meth:`state`."""
        return state.frame

    def _world(self, obs, reward, terminated, truncated) -> arrdict:
        """Returns the world after a step, in which lanes that had ended before it began again."""
        reset = self._ended.copy()
        terminal = terminated > reset
        truncated = truncated > (reset | terminal)
        np.logical_or(terminal, truncated, out=self._ended)
        return self._buffers.send(
            arrdict(
                obs=self._read(obs),
                reward=np.where(reset, 0.0, reward),
                reset=reset,
                terminal=terminal,
                truncated=truncated,
            )
        )
