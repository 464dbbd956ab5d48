"""N environments of Gymnasium, stepped one after the other. Workers import it, so without PyTorch.

An error of an environment is an EnvError, which has its traceback as text, or begins that
environment anew.
"""

import contextlib
import copy
import itertools
import numbers
import random
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

__all__ = [
    "EnvError",
    "SyncEnvs",
    "close_all",
    "make_env",
    "names_of_numbers",
    "one_line",
]

#: Steps and seconds of the episode that tells which numbers the last ``info`` has.
PROBE_STEPS, PROBE_SECONDS = 1000, 5.0


class EnvError(RuntimeError):
    """An environment of somebody else raised an error.

    Args:
        sentence: which environment, and its error.
        trace: the traceback of that error, as text.
    """

    def __init__(self, sentence: str, trace: str = ""):
        super().__init__(sentence, trace)
        self.trace = trace

    def __str__(self) -> str:
        return self.args[0]

    @classmethod
    def of(cls, error: Exception, place: str) -> "EnvError":
        """Returns an error of an environment, which the caller has just caught, as an EnvError.

        Args:
            place: what failed, such as `environment 3`.
        """
        frames = error.__traceback__ and error.__traceback__.tb_next  # without the caller's
        trace = "".join(traceback.format_exception(type(error), error, frames))
        return cls(f"{place} failed: {one_line(error)}", trace)


def one_line(error: BaseException) -> str:
    """Returns the type of an error and the first line of its message."""
    line = next(iter(str(error).strip().splitlines()), "")
    return ": ".join(filter(None, [type(error).__name__, line[:300]]))


def make_env(spec: Any, wrappers: Sequence[Callable], settings: Mapping[str, Any]) -> Any:
    """Returns an environment of Gymnasium by its specification, inside wrappers."""
    import gymnasium

    env = gymnasium.make(spec, **settings)
    for wrapper in wrappers:
        env = wrapper(env)
    return env


class SyncEnvs:
    """N environments with the interface of Gymnasium's vector environments. The step after an
    episode's end resets it.

    Args:
        make: makes one environment.
        n_envs: number of environments, N.
        restart_failed: how often each environment is made anew after an error. Its episode ends
            as truncated at its last observation, and the next one gets a seed of its own.
        names: keys of `info` whose numbers are returned at the end of an episode.
        first: number of the first environment, for messages.

    Attributes:
        restarts: (N,) int64, how often each was made anew.

    Raises:
        ValueError: the environments have different spaces.
    """

    def __init__(
        self,
        make: Callable[[], Any],
        n_envs: int,
        restart_failed: int = 0,
        names: Sequence[str] = (),
        first: int = 0,
    ):
        from gymnasium.vector.utils import batch_space, create_empty_array

        self.make, self.restart_failed, self.first = make, restart_failed, first
        self.names = tuple(names)
        self.envs = [make() for _ in range(n_envs)]
        example = self.envs[0]
        self.metadata, self.render_mode = dict(example.metadata), example.render_mode
        self.single_observation_space = example.observation_space
        self.single_action_space = example.action_space
        for env in self.envs:
            for kind in ("observation_space", "action_space"):
                if getattr(env, kind) != getattr(example, kind):
                    raise ValueError(f"two of its environments differ in their {kind}")
        self.actions = batch_space(self.single_action_space, n_envs)
        self.batch = create_empty_array(self.single_observation_space, n_envs)
        self.rewards = np.zeros(n_envs)
        self.terminated, self.truncated = np.zeros(n_envs, bool), np.zeros(n_envs, bool)
        self.restarts, self.seeds = np.zeros(n_envs, np.int64), np.zeros(n_envs, np.int64)
        self.is_new = np.zeros(n_envs, bool)  # made anew, and not seeded yet
        self._failures = []

    def reset(self, *, seed: Sequence[int] | None = None) -> tuple[Any, dict]:
        """Resets every environment. Returns (observations, news), see `step`."""
        if seed is not None:
            self.seeds[:] = seed
        seeds = itertools.repeat(None) if seed is None else seed
        latest = [self._reset(i, one) for i, one in zip(range(len(self.envs)), seeds)]
        self.rewards[:], self.terminated[:], self.truncated[:] = 0.0, False, False
        return self._observations(latest), self._news({})

    def step(self, actions: Any) -> tuple[Any, ...]:
        """Takes one step. Returns (observations, rewards, terminated, truncated, news), valid until
        the next call. News are a dict, empty in most steps, of

        - `numbers`: name -> (N,), of the last `info` where episodes end; else nan
        - `failures`: the EnvErrors after which environments were made anew
        """
        from gymnasium.vector.utils import iterate

        ended, latest, numbers = self.terminated | self.truncated, [], {}
        for i, action in enumerate(iterate(self.actions, actions)):
            if ended[i]:
                latest.append(self._reset(i))
                self.rewards[i], self.terminated[i], self.truncated[i] = 0.0, False, False
                continue
            try:
                obs, reward, terminated, truncated, info = self.envs[i].step(action)
            except Exception as error:
                self._begin_anew(i, error)
                obs, reward, terminated, truncated, info = self._last(i), 0.0, False, True, {}
            latest.append(obs)
            self.rewards[i], self.terminated[i], self.truncated[i] = reward, terminated, truncated
            if self.names and (terminated or truncated):
                numbers = numbers or {name: np.full(len(self.envs), np.nan) for name in self.names}
                for name, value in numbers_of(info).items():
                    if name in numbers:
                        numbers[name][i] = value
        flags = self.terminated.copy(), self.truncated.copy()
        return self._observations(latest), self.rewards.copy(), *flags, self._news(numbers)

    def render(self) -> list[Any]:
        """Returns a frame of every environment."""
        return [env.render() for env in self.envs]

    def close(self) -> None:
        """Closes every environment. Raises the first error, once all are closed."""
        close_all(self.envs)

    def _observations(self, latest):
        from gymnasium.vector.utils import concatenate

        self.batch = concatenate(self.single_observation_space, latest, self.batch)
        return self.batch

    def _news(self, numbers):
        failures, self._failures = self._failures, []
        news = {"numbers": numbers, "failures": failures}
        return {key: value for key, value in news.items() if value}

    def _last(self, i):
        """Returns a copy of the last observation of an environment."""
        from gymnasium.vector.utils import batch_space, iterate

        rows = iterate(batch_space(self.single_observation_space, len(self.envs)), self.batch)
        return copy.deepcopy(next(itertools.islice(rows, i, None)))

    def _reset(self, i, seed=None):
        while True:
            if self.is_new[i]:  # draws that no other environment has
                number = [int(self.seeds[i]), int(self.restarts[i])]
                seed = int(np.random.SeedSequence(number).generate_state(1)[0])
            try:
                obs, _ = self.envs[i].reset(**{} if seed is None else {"seed": seed})
            except Exception as error:
                self._begin_anew(i, error)
            else:
                self.is_new[i] = False
                return obs

    def _begin_anew(self, i, error) -> None:
        """Makes an environment again after an error. Raises EnvError if it had all its restarts."""
        failure = EnvError.of(error, f"environment {self.first + i}")
        if self.restarts[i] >= self.restart_failed or isinstance(error, MemoryError):
            raise error if isinstance(error, MemoryError) else failure from error
        self.restarts[i] += 1
        with contextlib.suppress(Exception):
            self.envs[i].close()
        try:
            self.envs[i] = self.make()
        except Exception as again:
            raise EnvError.of(again, f"environment {self.first + i}") from again
        self._failures.append(failure)
        self.is_new[i] = True


def close_all(envs: Sequence[Any]) -> None:
    """Closes environments. Raises the first error once all are closed, a TimeoutError at once."""
    errors = []
    for env in envs:
        try:
            env.close()
        except TimeoutError:
            raise
        except Exception as error:
            errors.append(error)
    if errors:
        raise errors[0]


# ---- Numbers of an episode's last info ----


def numbers_of(info: Any) -> dict[str, float]:
    """Returns the numbers of an `info` by key, without those in dicts and arrays of several."""
    values = {}
    for key, value in info.items() if isinstance(info, Mapping) else ():
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(())[()]
        if isinstance(key, str) and isinstance(value, (numbers.Real, np.bool_)):
            with contextlib.suppress(OverflowError):
                values[key] = float(value)
    return values


def names_of_numbers(env: Any, seed: int = 0) -> list[str]:
    """Plays an episode with random actions, of at most `PROBE_STEPS` and `PROBE_SECONDS`. Returns
    the keys of the numbers in its last `info`, `is_success` first. Closes the environment.

    An error ends it: the same one comes in training, which tells of it.
    """
    names, end = [], time.monotonic() + PROBE_SECONDS
    with _global_generators_kept(), contextlib.suppress(Exception):
        actions = copy.deepcopy(env.action_space)  # which may be that of a class
        actions.seed(seed)
        env.reset(seed=seed)
        for _ in range(PROBE_STEPS):
            *_, terminated, truncated, info = env.step(actions.sample())
            names = sorted(numbers_of(info), key=lambda name: name != "is_success")
            if terminated or truncated or time.monotonic() > end:
                break
    with contextlib.suppress(Exception):
        env.close()
    return names


@contextlib.contextmanager
def _global_generators_kept() -> Iterator[None]:
    """What is drawn inside leaves the generators of Python, NumPy and PyTorch as they were."""
    torch, states = sys.modules.get("torch"), (random.getstate(), np.random.get_state())
    of_torch = torch and torch.get_rng_state()
    try:
        yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])
        if torch:
            torch.set_rng_state(of_torch)
