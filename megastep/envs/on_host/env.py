"""VectorizedEnv: a vector environment that steps on the host, with the interface learners use.

N environments of A agents each, B = N A lanes.
"""

import contextlib
import functools
import warnings
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import torch

from megastep import engine, spaces
from megastep.arrdict import arrdict
from megastep.contract import FLAGS, RESERVED
from megastep.env_state import EnvState
from megastep.env_values import beyond_bounds
from megastep.envs.on_host.buffers import HostBuffers
from megastep.envs.on_host.frames import as_frame
from megastep.envs.on_host.spaces import RESERVED as RESERVED_KEYS
from megastep.envs.on_host.spaces import actions, identifiers, observation
from megastep.sync_envs import CHECKED_STEPS, BadValue, EnvError
from megastep.types import Tree
from megastep.vector_processes import VectorProcesses, start_rendering

__all__ = ["VectorizedEnv"]

#: The most numbers of an ``info`` that become metrics.
MAX_NUMBERS = 16
#: Steps of an episode in an evaluation, of environments whose specification names no limit.
MAX_EPISODE_STEPS = 10_000


class VectorizedEnv:
    """Wraps a vector environment that resets a lane in the step after its episode's end.

    Args:
        id: name of the environments in messages.
        vector: has ``single_observation_space``, ``single_action_space``, ``metadata``,
            ``render_mode``, ``reset(seed=)``, ``step(actions)``, ``render()`` and ``close()``, as
            Gymnasium's vector environments do, with a row per lane. If it has ``names``, the last
            part of a result is as that of :class:`~megastep.sync_envs.SyncEnvs`; if it has
            ``present``, that is a dict with ``present``, (B,) bool, the lanes whose next action is
            used. If ``n_masked`` is above 0, it has ``masks``, (B, n_masked) bool.
        n_envs: number of environments, N.
        n_agents: lanes per environment, A.
        seeds: passed to the first ``vector.reset``, one per environment or one for all.
        device: where worlds and actions are. Default: a GPU if there is one.
        check: refuses actions that are not finite, and in the first `CHECKED_STEPS` observations
            that are not in their space; warns of those beyond the bounds of a Box.

    Raises:
        ValueError: if a space has no conversion, with its name and the cure.
    """

    capturable = False
    _has_warned = False  # of an environment that was made anew

    def __init__(
        self,
        id: str | None,
        vector: Any,
        n_envs: int,
        n_agents: int,
        seeds: list[int] | int,
        device: torch.device | str | None,
        check: bool = True,
    ):
        self._checks = check
        self.id, self.vector, self.n_envs, self.n_agents = id, vector, n_envs, n_agents
        self.device = engine.device("auto" if device is None else device)
        self._seeds = seeds
        self.fps = float(vector.metadata.get("render_fps") or 10)
        self.max_episode_steps = getattr(vector, "max_episode_steps", None) or MAX_EPISODE_STEPS
        try:
            self.obs_space, self._read = observation(vector.single_observation_space)
            self.action_space, self._write = actions(vector.single_action_space)
        except ValueError as error:
            with contextlib.suppress(EnvError):
                self.close()
            raise ValueError(f"{id}: {error}") from None
        n_lanes = n_envs * n_agents
        names = getattr(vector, "names", ())
        if left_out := names[MAX_NUMBERS:]:
            warnings.warn(
                f"{id}: the last info of an episode has {len(names)} numbers; {MAX_NUMBERS} become "
                f"metrics, and {', '.join(left_out)} do not",
                stacklevel=3,
            )
        names = names[:MAX_NUMBERS]
        reserved = {*RESERVED_KEYS, *RESERVED, "restarts"}
        self._metrics = {
            name: (key, np.zeros(n_lanes, np.float32))
            for name, key in zip(identifiers(names, reserved), names)
        }
        if (n_masked := getattr(vector, "n_masked", 0)) < 0:
            warnings.warn(
                f"{id}: info['action_mask'] is not used: it must be a number per action of a "
                "Discrete space",
                stacklevel=3,
            )
        self._buffers = HostBuffers(
            *(n_lanes, self.obs_space, self.action_space, self.device, [*self._metrics]),
            flags=(*FLAGS, *["learns"] * hasattr(vector, "present")),
            n_masked=max(0, n_masked),
        )
        self._ended = np.ones(n_lanes, bool)
        self._n_restarts = np.zeros(1, np.int64)  # an array, so that checkpoints hold it
        self._n_to_check = np.full(1, CHECKED_STEPS if check else 0)

    def reset(self) -> arrdict:
        """Starts a new episode in every lane. Returns the first world.

        Raises:
            EnvError: an environment failed.
        """
        obs, news = self._call(self.vector.reset, seed=self._seeds)
        self._read_news(news, self._ended)
        self._seeds = None
        self._ended[:] = True
        return self._world(obs, np.zeros(len(self._ended)), self._ended, self._ended, news)

    def step(self, decision: Mapping) -> arrdict:
        """Takes one step by ``decision["actions"]``. Returns a world.

        Raises:
            EnvError: an environment failed.
        """
        actions = self._buffers.receive(decision["actions"])
        if self._checks:
            self._check_actions(actions)
        actions = self._write(actions)
        obs, reward, terminated, truncated, news = self._call(self.vector.step, actions)
        self._read_news(news, terminated | truncated)
        return self._world(obs, reward, terminated, truncated, news)

    def _check_actions(self, actions) -> None:
        """Raises BadValue for a NaN or an infinity."""
        for path, leaf in spaces.leaves(actions, "the action").items():
            if leaf.dtype.kind == "f" and not np.isfinite(leaf).all():
                lane = int(np.argwhere(~np.isfinite(leaf))[0][0])
                raise BadValue.of(
                    f"{path} for lane {lane} is not finite, so the policy's weights or "
                    "observations are not",
                    str(self.id),
                )

    def _check_observations(self, obs) -> None:
        """Raises BadValue for those outside their space, and warns once of those beyond a Box."""
        self._n_to_check -= 1
        for problem, is_box in beyond_bounds(self.vector.single_observation_space, obs):
            sentence = f"an observation is not in its space: {problem}"
            if not is_box:
                raise BadValue.of(sentence, str(self.id))
            self._n_to_check[:] = 0
            warnings.warn(f"{self.id}: {sentence}. It is used as it is", stacklevel=4)

    def wrapper_state(self) -> Tree:
        """Returns what the wrappers of an environment have learnt, such as running statistics, as
        tensors and numbers by path.
        """
        state = getattr(self.vector, "wrapper_state", dict)()
        return {path: _plain(value) for path, value in state.items()}

    def load_wrapper_state(self, state: Tree, is_frozen: bool) -> None:
        """Gives the wrappers of all environments what those of others have learnt.

        Args:
            state: of `wrapper_state`, on any device.
            is_frozen: it stays as it is from now on.

        Raises:
            ValueError: the environments are not in such wrappers.
        """
        state = {
            path: value.cpu().numpy() if isinstance(value, torch.Tensor) else value
            for path, value in state.items()
        }
        if not hasattr(self.vector, "load_wrapper_state"):
            raise ValueError(f"{self.id} is in no wrappers, as in the training of the agent")
        self.vector.load_wrapper_state(state, is_frozen)

    def pop_restarts(self) -> int | None:
        """Returns how many environments were made anew after an error since the last call, None if
        none ever is.
        """
        if not getattr(self.vector, "restart_failed", 0):
            return None
        n_restarts = int(self._n_restarts[0])
        self._n_restarts[:] = 0
        return n_restarts

    def _call(self, function, *arguments, **more) -> Any:
        """Calls a method of the environments. Raises EnvError for their errors."""
        try:
            return function(*arguments, **more)
        except EnvError as error:
            raise type(error)(f"{self.id}: {error}", error.trace) from error
        except MemoryError:
            raise
        except Exception as error:
            raise EnvError.of(error, f"{self.id}: an environment") from error

    def _read_news(self, news, ended) -> None:
        """Keeps the numbers of episodes that ended, and counts environments that were made anew."""
        if not news or not hasattr(self.vector, "names"):
            return
        for key, values in self._metrics.values():
            if "numbers" in news:
                np.copyto(values, news["numbers"][key], "unsafe", where=ended)
        for failure in news.get("failures", ()):
            if not self._has_warned:
                self._has_warned = True
                warnings.warn(
                    f"{self.id}: {failure}; it was made anew, as it and the others will be up to "
                    f"restart_failed={self.vector.restart_failed} times each; metrics count them "
                    "as episode/restarts",
                    stacklevel=3,
                )
            self._n_restarts += 1

    @functools.cached_property
    def resumable(self) -> bool:
        """False if checkpoints cannot hold the environments: those in other processes, and those
        whose state is not in Python, such as Box2D's.
        """
        is_here = not isinstance(self.vector, VectorProcesses)
        return is_here and not EnvState(self).unreachable()

    def close(self) -> None:
        """Closes the environments, and ends their processes.

        Raises:
            EnvError: an environment failed at it.
        """
        self._call(self.vector.close)

    def state(self, e: int = 0) -> arrdict:
        """Returns the frame of environment ``e``, (H, W, 3) uint8, as the environment renders it.

        Raises:
            ValueError: if it renders no images.
            EnvError: if it fails.
        """
        start_rendering(self.vector)
        if self.vector.render_mode != "rgb_array":
            raise ValueError(
                f"{self.id} renders no images: it has no render mode rgb_array, or env.kwargs "
                "chooses another"
            )
        try:
            return arrdict(frame=torch.from_numpy(as_frame(self._call(self.vector.render)[e])))
        except ValueError as error:
            raise ValueError(f"{self.id}: {error}") from None

    @staticmethod
    def plot_state(state: arrdict) -> np.ndarray:
        """Returns the frame of a numpyified :meth:`state`."""
        return state.frame

    def _world(self, obs, reward, terminated, truncated, news) -> arrdict:
        """Returns the world after a step, in which lanes that had ended before it began again."""
        reset = self._ended.copy()
        terminal = terminated > reset
        truncated = truncated > (reset | terminal)
        if self._n_to_check[0] > 0:
            self._check_observations(obs)
        present = news.get("present") if isinstance(news, Mapping) else None
        self._ended[:] = (terminal | truncated) if present is None else ~present
        world = arrdict(
            obs=self._read(obs),
            reward=np.where(reset, 0.0, reward),
            reset=reset,
            terminal=terminal,
            truncated=truncated,
        )
        if present is not None:
            world["learns"] = present.copy()
        if self._metrics:
            world["metrics"] = arrdict({name: of[1] for name, of in self._metrics.items()})
        if getattr(self.vector, "n_masked", 0) > 0:
            world["mask"] = news["masks"][:, None]
        return self._buffers.send(world)


def _plain(value) -> object:
    """Returns a value of a wrapper in a form that checkpoints hold."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.array(value, order="C"))
    if isinstance(value, Collection):
        return [getattr(part, "item", lambda part=part: part)() for part in value]
    return value.item() if isinstance(value, np.generic) else value
