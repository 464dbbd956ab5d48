"""VectorizedEnv: a vector environment that steps on the host, with the interface learners use.

N environments of A agents each, B = N A lanes.
"""

import contextlib
import functools
import warnings
from collections.abc import Collection, Iterator, Mapping
from typing import Any

import numpy as np
import torch

from megastep import engine, spaces
from megastep.arrdict import arrdict
from megastep.contract import RESERVED
from megastep.env_state import EnvState
from megastep.hosting.conversions import RESERVED as RESERVED_KEYS
from megastep.hosting.conversions import actions, identifiers, observation
from megastep.hosting.env_error import BadValue, EnvError, one_line
from megastep.types import Tree

#: The most numbers of an ``info`` that become metrics.
MAX_NUMBERS = 16
#: Steps of an episode in an evaluation, of environments whose specification names no limit.
MAX_EPISODE_STEPS = 10_000
DTYPES: Any = {torch.uint8: np.uint8, torch.float32: np.float32}


class VectorizedEnv:
    """Wraps a vector environment that resets a lane in the step after its episode's end.

    Args:
        id: name of the environments in messages.
        vector: environments with a row per lane: :class:`~megastep.hosting.hosted.HostedEnvs`, or
            ones with the same methods.
        seed: from which each environment's seed at its first reset derives.
        check: refuses actions that are not finite, and in the first `CHECKED_STEPS` observations
            that are not in their space; warns of those beyond the bounds of a Box.
    """

    capturable = False
    HAS_PLAIN_STATE = True  # see :mod:`megastep.env_state`

    def __init__(
        self,
        id: str | None,
        vector: Any,
        n_envs: int,
        n_agents: int,
        seed: int,
        device: torch.device | str | None,
        check: bool = True,
    ):
        from megastep.hosting.probe import CHECKED_STEPS

        self.id, self.vector, self.n_envs, self.n_agents = id, vector, n_envs, n_agents
        self.device = engine.device("auto" if device is None else device)
        self._seeds: list | None = np.random.SeedSequence(seed).generate_state(n_envs).tolist()
        self._checks, self._n_to_check = check, CHECKED_STEPS if check else 0
        self.fps = float(vector.metadata.get("render_fps") or 10)
        self.max_episode_steps = vector.max_episode_steps or MAX_EPISODE_STEPS
        try:
            self.obs_space, self._read = observation(vector.single_observation_space)
            self.action_space, self._write = actions(vector.single_action_space)
        except ValueError as error:
            with contextlib.suppress(EnvError):
                self.close()
            raise ValueError(f"{id}: {error}") from None
        found, problems = vector.found, []
        if left_out := found.names[MAX_NUMBERS:]:
            problems.append(
                f"the last info of an episode has {len(found.names)} numbers; {MAX_NUMBERS} "
                f"become metrics, and {', '.join(left_out)} do not"
            )
        if found.n_masked < 0:
            must = "it must be a number per action of a Discrete space"
            problems += [f"info['action_mask'] is not used: {must}"]
        for problem in problems:
            warnings.warn(f"{id}: {problem}", stacklevel=3)
        self._metrics = identifiers(found.names[:MAX_NUMBERS], {*RESERVED_KEYS, *RESERVED})
        self._has_mask = found.n_masked > 0
        self._ended = np.ones(n_envs * n_agents, bool)

    def reset(self) -> arrdict:
        """Starts a new episode in every lane. Returns the first world. Raises EnvError."""
        seeds, self._seeds = self._seeds, None
        self._ended[:] = True
        return self._world(*self._call(self.vector.reset, seed=seeds))

    def step(self, decision: Mapping) -> arrdict:
        """Takes one step by ``decision["actions"]``. Returns a world. Raises EnvError."""
        chosen = decision["actions"]
        chosen = spaces.map(lambda _, leaf: leaf.cpu().numpy(), self.action_space, chosen)
        for path, leaf in spaces.leaves(chosen, "the action").items() if self._checks else ():
            if leaf.dtype.kind == "f" and not np.isfinite(leaf).all():
                lane = int(np.argwhere(~np.isfinite(leaf))[0][0])
                raise BadValue.of(
                    f"{path} for lane {lane} is not finite, so the policy's weights or "
                    "observations are not",
                    str(self.id),
                )
        return self._world(*self._call(self.vector.step, self._write(chosen)))

    def wrapper_state(self) -> Tree:
        """Returns what the wrappers of an environment have learnt, tensors and numbers by path."""
        return {path: _plain(value) for path, value in self.vector.wrapper_state().items()}

    def load_wrapper_state(self, state: Tree, is_frozen: bool) -> None:
        """Gives all wrappers what others have learnt, to stay if it `is_frozen`. ValueError."""
        tensors = {p: x.cpu().numpy() for p, x in state.items() if isinstance(x, torch.Tensor)}
        self.vector.load_wrapper_state({**state, **tensors}, is_frozen)

    @functools.cached_property
    def resumable(self) -> bool:
        """False for other processes, and state that is not in Python, such as Box2D's."""
        return not hasattr(self.vector, "processes") and not EnvState(self).unreachable()

    def close(self) -> None:
        """Closes the environments, and ends their processes. Raises EnvError."""
        self._call(self.vector.close)

    def state(self, e: int = 0) -> arrdict:
        """Returns the frame of environment ``e``, (H, W, 3) uint8. ValueError if it has none."""
        from megastep.video import as_image  # with Pillow, which stepping does without

        self._call(self.vector.start_rendering)
        if self.vector.render_mode != "rgb_array":
            raise ValueError(
                f"{self.id} renders no images: it has no render mode rgb_array, or env.kwargs "
                "chooses another"
            )
        try:
            return arrdict(frame=torch.from_numpy(as_image(self._call(self.vector.render)[e])))
        except ValueError as error:
            raise ValueError(f"{self.id}: {error}") from None

    @staticmethod
    def plot_state(state: arrdict) -> np.ndarray:
        """Returns the frame of a numpyified :meth:`state`."""
        return state.frame

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

    def _world(self, obs, reward, terminated, truncated, infos) -> arrdict:
        """Returns the world after a step, in which lanes that had ended before it began again."""
        if self._n_to_check > 0:
            from megastep.hosting.probe import beyond_bounds

            self._n_to_check -= 1
            for problem, is_box in beyond_bounds(self.vector.single_observation_space, obs):
                sentence = f"an observation is not in its space: {problem}"
                if not is_box:
                    raise BadValue.of(sentence, str(self.id))
                self._n_to_check = 0
                warnings.warn(f"{self.id}: {sentence}. It is used as it is", stacklevel=3)
        reset, present = self._ended.copy(), infos.get("present")
        self._ended[:] = terminated | truncated if present is None else ~present

        def copied(space, values) -> np.ndarray:
            dtype = DTYPES.get(getattr(space, "dtype", None), np.int64)
            return np.array(values, dtype, order="C")

        world = dict(
            obs=spaces.map(copied, self.obs_space, self._read(obs)),
            reward=reward.astype(np.float32),
            reset=reset,
            terminal=terminated.copy(),
            truncated=truncated & ~terminated,
        )
        if present is not None:
            world["learns"] = present.copy()
        if self._metrics:
            columns = infos["numbers"].astype(np.float32).T.copy()
            world["metrics"] = arrdict(zip(self._metrics, columns))
        if self._has_mask:
            world["mask"] = infos["action_mask"][:, None].copy()
        world = arrdict(world).map(torch.from_numpy)
        if self.device.type == "cpu":
            return world
        return world.map(lambda leaf: leaf.pin_memory().to(self.device, non_blocking=True))


@contextlib.contextmanager
def one_sentence(id: str | None, kwargs: dict | None) -> Iterator[None]:
    """Raises whatever another's constructor raises as a ValueError with the first line of it."""
    try:
        yield
    except Exception as error:
        line = str(error) if isinstance(error, ValueError) else one_line(error)
        line, *_ = line.strip().partition("\n")
        line, *_ = line.partition(" was raised from the environment creator")
        cause = f" with env.kwargs={kwargs}" if kwargs else ""
        raise ValueError(f"{id} cannot be made{cause}: {line}") from error


def _plain(value) -> object:
    """Returns a value of a wrapper in a form that checkpoints hold."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.array(value, order="C"))
    if isinstance(value, Collection):
        return [getattr(part, "item", lambda part=part: part)() for part in value]
    return value.item() if isinstance(value, np.generic) else value
