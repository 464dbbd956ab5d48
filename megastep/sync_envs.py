"""N environments of Gymnasium, stepped one after the other. Workers import it, so without PyTorch.

An error of an environment is an EnvError, which has its traceback as text, or begins that
environment anew.
"""

import contextlib
import copy
import functools
import itertools
import numbers
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from megastep.env_values import problem_of_error, problem_of_result
from megastep.global_generators import KINDS, GlobalGenerators
from megastep.types import Tree
from megastep.wrapper_state import WrappedEnvs, load_wrapper_state, wrapper_state

if TYPE_CHECKING:
    import gymnasium
    from gymnasium.envs.registration import EnvSpec

__all__ = [
    "TRUE_RETURN",
    "BadValue",
    "EnvError",
    "RewardRecorder",
    "SyncEnvs",
    "allowed_actions",
    "close_all",
    "make_env",
    "numbers_of",
    "one_line",
]

#: Name of the sum of an episode's rewards before wrappers change them.
TRUE_RETURN = "true_return"
#: Steps of each environment in which the form of its values is checked.
CHECKED_STEPS = 100


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
        while frames and frames.tb_frame.f_code.co_filename == __file__:
            frames = frames.tb_next
        trace = "".join(traceback.format_exception(type(error), error, frames))
        return cls(f"{place} failed: {one_line(error)}", trace)


def one_line(error: BaseException) -> str:
    """Returns the type of an error and the first line of its message."""
    line = next(iter(str(error).strip().splitlines()), "")
    return ": ".join(filter(None, [type(error).__name__, line[:300]]))


def make_env(spec: "EnvSpec", wrappers: Sequence[Callable], settings: Mapping) -> "gymnasium.Env":
    """Returns an environment of Gymnasium by its specification, inside wrappers."""
    import gymnasium

    env = gymnasium.make(spec, **settings)
    if wrappers:
        env = RewardRecorder.around(env)
    for wrapper in wrappers:
        env = wrapper(env)
    return env


class BadValue(EnvError):
    """An environment gave what its spaces or Gymnasium's interface do not allow."""

    @classmethod
    def of(cls, problem: str, place: str) -> "BadValue":
        return cls(f"{place}: {problem}. To leave it as it is, use env.check=false")


def allowed_actions(info: Mapping, n: int, place: str) -> np.ndarray:
    """Returns the mask of an ``info``, (n,) bool. One that allows nothing, as at an episode's end,
    counts as one that allows all; so does none.

    Raises:
        BadValue: it is of another shape.
    """
    mask = np.asarray(info.get("action_mask", np.ones(n)), bool)
    if mask.shape != (n,):
        problem = f"info['action_mask'] has shape {mask.shape}, and before it had ({n},)"
        raise BadValue.of(problem, place)
    return mask if mask.any() else np.ones(n, bool)


class RewardRecorder:
    """Keeps the last reward of an environment, which wrappers around it may change."""

    recorded_reward = 0.0

    @staticmethod
    @functools.cache
    def _wrapper() -> type:
        import gymnasium

        class Recorder(gymnasium.Wrapper, RewardRecorder):
            def step(self, action) -> tuple:
                result = super().step(action)
                self.recorded_reward = result[1]
                return result

        return Recorder

    @classmethod
    def around(cls, env) -> Any:
        """Returns a wrapper around an environment that keeps its last `recorded_reward`."""
        return cls._wrapper()(env)

    @classmethod
    def inside(cls, env) -> Any:
        """Returns the wrapper of `around` in other wrappers, None if there is none."""
        while env is not None and not isinstance(env, cls):
            env = vars(env).get("env")
        return env


class SyncEnvs(WrappedEnvs):
    """N environments with the interface of Gymnasium's vector environments. The step after an
    episode's end resets it.

    Args:
        make: makes one environment.
        n_envs: number of environments, N.
        restart_failed: how often each environment is made anew after an error. Its episode ends
            as truncated at its last observation, and the next one gets a seed of its own.
        names: keys of `info` whose numbers are returned at the end of an episode.
        first: number of the first environment.
        seed: of the global generators that each environment finds.
        generators: kinds of global generators that the environments draw from.
        learnt: paths of what their wrappers have learnt.
        check: checks the form of what the environments return in their first `CHECKED_STEPS`.
        n_masked: actions of the mask in ``info["action_mask"]``, see `masked_actions`.

    Attributes:
        restarts: (N,) int64, how often each was made anew.

    Raises:
        ValueError: the environments have different spaces.
    """

    max_episode_steps: int | None = None

    def __init__(
        self,
        make: "Callable[[], gymnasium.Env]",
        n_envs: int,
        restart_failed: int = 0,
        names: Sequence[str] = (),
        first: int = 0,
        seed: int = 0,
        generators: Collection[str] = KINDS,
        learnt: Collection[str] = (),
        check: bool = True,
        n_masked: int = 0,
    ):
        from gymnasium.vector.utils import batch_space, create_empty_array

        self.make, self.restart_failed = make, restart_failed
        self.first, self.seed = first, seed
        self.generators = [GlobalGenerators([seed, first + i]) for i in range(n_envs)]
        self.kinds = KINDS
        self.envs = [self._make(i) for i in range(n_envs)]
        self.use(names, generators, learnt, n_masked)
        self.checks = check
        self.n_checked, self.true_returns = np.zeros(n_envs, np.int64), np.zeros(n_envs)
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

    def use(
        self,
        names: Sequence[str],
        kinds: Collection[str],
        learnt: Collection[str],
        n_masked: int = 0,
    ) -> None:
        """Sets what a `Probe` has told, see above."""
        self.n_masked = n_masked
        self.masks = np.ones((len(self.envs), max(0, n_masked)), bool)
        self.names, self.learnt, self.kinds = tuple(names), tuple(learnt), tuple(kinds)
        for generators in self.generators:
            generators.drop({*KINDS} - {*kinds})  # which checkpoints need not hold
        self.recorders = (
            [*map(RewardRecorder.inside, self.envs)] if TRUE_RETURN in self.names else []
        )

    def reset(self, *, seed: Sequence[int] | None = None) -> tuple[Tree, dict]:
        """Resets every environment. Returns (observations, news), see `step`."""
        if seed is not None:
            self.seeds[:] = seed
        seeds = itertools.repeat(None) if seed is None else seed
        latest = [self._reset(i, one) for i, one in zip(range(len(self.envs)), seeds)]
        self.rewards[:], self.terminated[:], self.truncated[:] = 0.0, False, False
        return self._observations(latest), self._news({})

    def step(self, actions: Tree) -> tuple:
        """Takes one step. Returns (observations, rewards, terminated, truncated, news), valid until
        the next call. News are a dict, empty in most steps, of

        - `numbers`: name -> (N,), of the last `info` where episodes end; else nan
        - `failures`: the EnvErrors after which environments were made anew
        - `masks`: (N, n) bool, allowed actions, in every step if there are masks
        """
        from gymnasium.vector.utils import iterate

        ended, latest, numbers = self.terminated | self.truncated, [], {}
        for i, action in enumerate(iterate(self.actions, actions)):
            if ended[i]:
                latest.append(self._reset(i))
                self.rewards[i], self.terminated[i], self.truncated[i] = 0.0, False, False
                continue
            try:
                result = self._call(i, "step", action)
                obs, reward, terminated, truncated, info = result
                self._read_mask(i, info)
                if self.recorders:
                    self.true_returns[i] += self.recorders[i].recorded_reward
            except Exception as error:
                self._begin_anew(i, error)
                obs, reward, terminated, truncated, info = self._last(i), 0.0, False, True, {}
            latest.append(obs)
            self.rewards[i], self.terminated[i], self.truncated[i] = reward, terminated, truncated
            if self.names and (terminated or truncated):
                numbers = numbers or {name: np.full(len(self.envs), np.nan) for name in self.names}
                own = {TRUE_RETURN: self.true_returns[i]} if self.recorders else {}
                for name, value in (numbers_of(info) | own).items():
                    if name in numbers:
                        numbers[name][i] = value
        flags = self.terminated.copy(), self.truncated.copy()
        return self._observations(latest), self.rewards.copy(), *flags, self._news(numbers)

    def render(self) -> list:
        """Returns a frame of every environment."""
        return [env.render() for env in self.envs]

    def close(self) -> None:
        """Closes every environment. Raises the first error, once all are closed."""
        close_all(self.envs)

    def _make(self, i) -> "gymnasium.Env":
        with self.generators[i].installed(self.kinds) if self.kinds else contextlib.nullcontext():
            return self.make()

    def _call(self, i, method, *arguments, **more) -> Any:
        """Calls a method of an environment, which draws from global generators of its own."""
        env, problem = self.envs[i], None
        is_checked = self.checks and self.n_checked[i] < CHECKED_STEPS
        try:
            if self.kinds:
                with self.generators[i].installed(self.kinds):
                    result = getattr(env, method)(*arguments, **more)
            else:
                result = getattr(env, method)(*arguments, **more)
        except (TypeError, ValueError) as error:
            if not is_checked or not (problem := problem_of_error(method, error)):
                raise
        self._keep_frozen(env)
        if is_checked:
            self.n_checked[i] += 1
            problem = problem or problem_of_result(method, result, env.observation_space)
            if problem:
                raise BadValue.of(problem, f"environment {self.first + i}")
        return result

    def _observations(self, latest) -> object:
        from gymnasium.vector.utils import concatenate

        self.batch = concatenate(self.single_observation_space, latest, self.batch)
        return self.batch

    def _news(self, numbers) -> dict[str, np.ndarray]:
        failures, self._failures = self._failures, []
        news = {"numbers": numbers, "failures": failures}
        news = {key: value for key, value in news.items() if value}
        return {**news, "masks": self.masks.copy()} if self.n_masked > 0 else news

    def _read_mask(self, i, info) -> None:
        """Keeps an environment's mask."""
        if self.n_masked > 0:
            self.masks[i] = allowed_actions(info, self.n_masked, f"environment {self.first + i}")

    def _last(self, i) -> object:
        """Returns a copy of the last observation of an environment."""
        from gymnasium.vector.utils import batch_space, iterate

        rows = iterate(batch_space(self.single_observation_space, len(self.envs)), self.batch)
        return copy.deepcopy(next(itertools.islice(rows, i, None)))

    def _reset(self, i, seed=None) -> object:
        while True:
            if self.is_new[i]:  # draws that no other environment has
                number = [int(self.seeds[i]), int(self.restarts[i])]
                seed = int(np.random.SeedSequence(number).generate_state(1)[0])
            try:
                obs, info = self._call(i, "reset", **{} if seed is None else {"seed": seed})
                self._read_mask(i, info)
            except Exception as error:
                self._begin_anew(i, error)
            else:
                self.is_new[i], self.true_returns[i] = False, 0.0
                return obs

    def _begin_anew(self, i, error) -> None:
        """Makes an environment again after an error. Raises EnvError if it had all its restarts."""
        if isinstance(error, BadValue):
            raise error
        failure = EnvError.of(error, f"environment {self.first + i}")
        if self.restarts[i] >= self.restart_failed or isinstance(error, MemoryError):
            raise error if isinstance(error, MemoryError) else failure from error
        self.restarts[i] += 1
        learnt = wrapper_state(self.envs[i], self.learnt) if self.learnt else {}
        with contextlib.suppress(Exception):
            self.envs[i].close()
        try:
            self.envs[i] = self._make(i)
            load_wrapper_state(self.envs[i], learnt)
        except Exception as again:
            raise EnvError.of(again, f"environment {self.first + i}") from again
        if self.recorders:
            self.recorders[i] = RewardRecorder.inside(self.envs[i])
        self._failures.append(failure)
        self.is_new[i] = True


def close_all(envs: "Sequence[gymnasium.Env]") -> None:
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


def numbers_of(info: object) -> dict[str, float]:
    """Returns the numbers of an `info` by key, without those in dicts and arrays of several."""
    values = {}
    for key, value in info.items() if isinstance(info, Mapping) else ():
        if isinstance(value, np.ndarray) and value.size == 1:
            value = value.reshape(())[()]
        if isinstance(key, str) and isinstance(value, (numbers.Real, np.bool_)):
            with contextlib.suppress(OverflowError):
                values[key] = float(value)
    return values
