"""Gymnasium: N copies of any environment of Gymnasium, one agent each, so B = N lanes.

They step on the CPU, whichever device the learner is on.
"""

import functools
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field

from megastep import engine
from megastep.arrdict import arrdict
from megastep.env_state import EnvState
from megastep.envs.gymnasium.host import HostBuffers
from megastep.envs.gymnasium.make import vector_env
from megastep.envs.gymnasium.spaces import actions, observation
from megastep.settings import checked
from megastep.vector_processes import VectorProcesses

__all__ = ["Gymnasium"]

#: Environments that step on the host are counted in hundreds; more is a typing error.
MAX_ENVS = 2**16


class Gymnasium:
    """Any environment of Gymnasium, or of a package that registers its own with it.

    Gymnasium's vector environment steps them on the CPU: one after the other in this process
    (sync), each in a process of its own (async), or together, by the environment's own class (own).
    With a learner on a GPU, observations and actions cross through pinned memory.

    Observation:
        Box: (B, 1, n) float32, flattened, or an image (B, 1, C, H, W), uint8 or float32, if it has
        8 rows and columns or more and up to 4 channels. Discrete: (B, 1) integers from 0.
        MultiDiscrete: (B, k) integers, or a dict of its numbers if their ranges differ.
        MultiBinary: (B, 1, n) float32. Tuple and Dict: a dict.

    Actions:
        Discrete: (B, 1) integers from 0. MultiDiscrete: (B, k), or a dict if the ranges differ.
        MultiBinary: (B, k), 0 or 1. Box with bounds: (B, 1, n) float32 within them. Tuple and Dict:
        a dict.

    Reward:
        The environment's own.

    Episode end:
        Terminal and truncated as the environment says. If it says both, terminal.

    Metrics:
        None.

    Args:
        n_envs: number of environments, N.
        id: name of the environment, such as CartPole-v1; with a colon, ``package:Name-v0``, of a
            package that is imported first.
        kwargs: arguments of the environment's constructor.
        wrappers: import paths of Gymnasium's wrappers, ``package.module:Wrapper``, put around every
            environment in this order.
        vectorization: sync, async or own.
        seed: each environment is reset with a seed of its own, which derives from this one.
        device: where worlds and actions are. Default: a GPU if there is one.
    """

    n_agents, capturable = 1, False

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 32,
        *,
        id: str | None = None,
        kwargs: dict[str, Any] | None = None,
        wrappers: tuple[str, ...] = (),
        vectorization: Literal["sync", "async", "own"] = "sync",
        seed: int = 1,
        device: torch.device | str | None = None,
    ):
        self.id, self.n_envs, self.device = id, n_envs, engine.device(device)
        self.vector = vector_env(id, n_envs, kwargs or {}, wrappers, vectorization)
        self.fps = float(self.vector.metadata.get("render_fps") or 10)
        try:
            self.obs_space, self._read = observation(self.vector.single_observation_space)
            self.action_space, self._write = actions(self.vector.single_action_space)
        except ValueError as error:
            self.close()
            raise ValueError(f"{id}: {error}") from None
        self._buffers = HostBuffers(n_envs, self.obs_space, self.action_space, self.device)
        # one seed for all, or one each
        n_seeds = 1 if vectorization == "own" else n_envs
        seeds = np.random.SeedSequence(seed).generate_state(n_seeds).tolist()
        self._seeds = seeds[0] if vectorization == "own" else seeds
        self._ended = np.ones(n_envs, bool)

    def reset(self) -> arrdict:
        """Starts a new episode in every lane. Returns the first world."""
        obs, _ = self.vector.reset(seed=self._seeds)
        self._seeds = None
        self._ended[:] = True
        return self._world(obs, np.zeros(self.n_envs), self._ended, self._ended)

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

    def _world(self, obs, reward, terminated, truncated):
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
