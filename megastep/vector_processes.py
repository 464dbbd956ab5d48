"""Steps Gymnasium's environments in worker processes, one per CPU core.

Workers import Gymnasium and what the environments need, but not PyTorch.
"""

import contextlib
import multiprocessing
import os
import signal
import sys
import time
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from megastep import global_generators, workers
from megastep.env_probe import Probe, probe
from megastep.sync_envs import EnvError, SyncEnvs
from megastep.types import Tree

__all__ = ["VectorProcesses", "start_rendering"]

#: Seconds in which a worker that is to end may finish what it does.
PATIENCE = 5


class VectorProcesses:
    """N environments in worker processes, with the interface of Gymnasium's vector environments.

    Each environment gets the same seed as in one process, so the numbers are the same. The workers
    end with :meth:`close`, with this object, or with the process that made it, even if that is
    killed.

    Args:
        make: ``make(n_envs=n, first=i)`` returns :class:`~megastep.sync_envs.SyncEnvs`. It is sent
            to the workers.
        n_envs: number of environments, N.
        n_processes: number of processes. Default: one per core, shared among the ranks of a host.
    """

    max_episode_steps: int | None = None

    def __init__(self, make: Callable[..., SyncEnvs], n_envs: int, n_processes: int | None = None):
        import loky
        from gymnasium.vector.utils import create_empty_array
        from loky.backend import get_context

        if n_processes is None:
            n_processes = loky.cpu_count() // int(os.environ.get("LOCAL_WORLD_SIZE", 1))
        example = make(n_envs=1)
        self.metadata, self.render_mode = example.metadata, example.render_mode
        self.single_observation_space = example.single_observation_space
        self.single_action_space = example.single_action_space
        self.restart_failed = example.restart_failed
        with contextlib.suppress(Exception):
            example.close()
        edges = np.linspace(0, n_envs, min(max(n_processes, 1), n_envs) + 1).astype(int).tolist()
        self.rows = [slice(*pair) for pair in zip(edges, edges[1:])]
        self.observations = create_empty_array(self.single_observation_space, n_envs)
        self.results = np.zeros(n_envs), np.zeros(n_envs, bool), np.zeros(n_envs, bool)
        self.pipes, self.processes = [], []
        self._finalizer = weakref.finalize(self, _end, self.pipes, self.processes)
        context = get_context("loky")  # a new interpreter: a fork would share locks and threads
        with workers.terminal_signals_blocked():
            for rows in self.rows:
                pipe, far_end = multiprocessing.Pipe()
                process = context.Process(  # pyright: ignore[reportAttributeAccessIssue]
                    target=_serve,
                    args=(far_end, make, rows),
                    daemon=True,
                    env=workers.WORKER_ENV,
                )
                process.start()
                far_end.close()
                self.pipes.append(pipe)
                self.processes.append(process)
        self.pipes[0].send(("probe", None))
        found = self._receive(0)
        found = Probe() if isinstance(found, Exception) else found
        self.names, self.learnt, self.latest_state = found.names, found.learnt, {}
        self.n_masked = found.n_masked
        self._ask("use", [found for _ in self.pipes])

    def reset(self, *, seed: Sequence[int] | None = None) -> tuple[Tree, dict]:
        """Resets every environment. Returns (observations, news), see `step`."""
        answers = self._ask("reset", [seed and list(seed[rows]) for rows in self.rows])
        for rows, (obs, _) in zip(self.rows, answers):
            _write(self.observations, rows, obs)
        return self.observations, self._news([news for _, news in answers])

    def step(self, actions: Tree) -> tuple:
        """Takes one step. Returns (observations, rewards, terminated, truncated, news), which are
        valid until the next call. News are those of :class:`~megastep.sync_envs.SyncEnvs`.
        """
        answers = self._ask("step", [_read(actions, rows) for rows in self.rows])
        for rows, (obs, *results, _) in zip(self.rows, answers):
            _write(self.observations, rows, obs)
            _write(self.results, rows, results)
        return self.observations, *self.results, self._news([news for *_, news in answers])

    def render(self) -> list:
        """Returns a frame of every environment."""
        return [frame for frames in self._ask("render", self.rows) for frame in frames]

    def wrapper_state(self) -> Tree:
        """Returns what the wrappers of the first environment have learnt, by path; of a process
        that has ended, what it was at the last call.
        """
        if self.learnt:
            with contextlib.suppress(OSError, EnvError, MemoryError):
                self.pipes[0].send(("wrapper_state", None))
                answer = self._receive(0)
                if not isinstance(answer, Exception):
                    self.latest_state = answer
        return self.latest_state

    def load_wrapper_state(self, state: Tree, is_frozen: bool) -> None:
        """As :meth:`SyncEnvs.load_wrapper_state`."""
        self._ask("load_wrapper_state", [(state, is_frozen) for _ in self.pipes])

    def close(self) -> None:
        """Closes the environments and ends their processes, by force after `PATIENCE` seconds.

        Raises:
            EnvError: the first error of an environment that could not be closed.
        """
        answers, pipes = [], [*self.pipes]
        for pipe in pipes:
            with contextlib.suppress(EOFError, OSError):  # it has ended
                pipe.send(("close", None))
        end = time.monotonic() + PATIENCE
        for pipe in pipes:
            with contextlib.suppress(EOFError, OSError):
                if pipe.poll(max(0.0, end - time.monotonic())):
                    answers.append(pipe.recv())
                else:
                    answers.append(EnvError(f"close() did not return in {PATIENCE} s"))
        self._finalizer()
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer

    def _ask(self, command, arguments) -> list:
        """Returns the answer of each process to a command."""
        for pipe, argument in zip(self.pipes, arguments, strict=True):
            with contextlib.suppress(OSError):  # of a process that has ended, as its answer tells
                pipe.send((command, argument))
        answers = [self._receive(number) for number in range(len(self.pipes))]
        for error in answers:
            if isinstance(error, Exception):
                raise error
        return answers

    def _receive(self, number) -> Any:
        """Returns the answer of a process, which may be an error of an environment.

        Raises:
            MemoryError: it was killed.
            EnvError: it has ended otherwise.
        """
        try:
            return self.pipes[number].recv()
        except (EOFError, OSError):
            process, rows = self.processes[number], self.rows[number]
        process.join(PATIENCE)
        code = process.exitcode
        if code in (None, -signal.SIGKILL):
            raise MemoryError(
                "a process that steps environments was killed, perhaps because memory ran out"
            )
        how = f"with exit code {code}" if code >= 0 else f"by {signal.Signals(-code).name}"
        raise EnvError(
            f"the process that steps environments {rows.start} to {rows.stop - 1} was ended {how}"
        )

    def _news(self, of_processes) -> dict:
        """Returns the news of all environments."""
        news: dict = {
            "failures": [one for part in of_processes for one in part.get("failures", ())]
        }
        if any("numbers" in part for part in of_processes):
            n_envs = self.rows[-1].stop
            news["numbers"] = {name: np.full(n_envs, np.nan) for name in self.names}
            for rows, part in zip(self.rows, of_processes):
                for name, values in part.get("numbers", {}).items():
                    news["numbers"][name][rows] = values
        news = {key: value for key, value in news.items() if value}
        if self.n_masked > 0:
            news["masks"] = np.concatenate([part["masks"] for part in of_processes])
        return news


def start_rendering(vector) -> None:
    """Sets the render mode of environments to rgb_array, if they have it and no other was chosen.

    Called before the first frame and not earlier: with a render mode, LunarLander simulates the
    particles of its exhaust and steps at a third of the speed.
    """
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # else pygame complains of no display
    if vector.render_mode is None and "rgb_array" in vector.metadata.get("render_modes", ()):
        for env in getattr(vector, "envs", ()):
            env.unwrapped.render_mode = "rgb_array"
        vector.render_mode = "rgb_array"


def _serve(pipe, make, rows) -> None:
    """Answers commands until the pipe is closed, which it is when the other process ends."""
    envs = _attempt(make, n_envs=rows.stop - rows.start, first=rows.start)
    if not isinstance(envs, Exception):  # for what draws too rarely to be found by a probe
        seeds = np.random.SeedSequence([envs.seed, envs.first])
        global_generators.seed_all(int(seeds.generate_state(1)[0]))
    with contextlib.suppress(EOFError, OSError):
        while True:
            command, argument = pipe.recv()
            if isinstance(envs, Exception):
                pipe.send(envs)
            else:
                pipe.send(_attempt(_answer, envs, command, argument))
            if command == "close":
                return
    with contextlib.suppress(Exception):
        if not isinstance(envs, Exception):
            envs.close()


def _answer(envs, command, argument) -> object:
    if command == "reset":
        return envs.reset(seed=argument)
    if command == "step":
        return envs.step(argument)
    if command == "probe":
        return probe(envs.make)
    if command == "use":
        return envs.use(*argument)
    if command == "wrapper_state":
        return envs.wrapper_state()
    if command == "load_wrapper_state":
        return envs.load_wrapper_state(*argument)
    if command == "close":
        return envs.close()
    start_rendering(envs)
    return envs.render()


def _attempt(function, *arguments, **more) -> Any:
    """Returns what a function returns, or its error, in a form that can be sent."""
    try:
        return function(*arguments, **more)
    except (EnvError, MemoryError) as error:
        return error if isinstance(error, EnvError) else MemoryError(*map(str, error.args))
    except Exception as error:
        return EnvError.of(error, "an environment")


def _end(pipes, processes) -> None:
    for pipe in pipes:
        pipe.close()
    for process in processes:
        process.join(PATIENCE)
        if process.is_alive():
            process.kill()
            process.join()


def _write(to, rows, values) -> None:
    """Copies the values of some environments into the batch of all."""
    if isinstance(to, dict):
        to, values = to.values(), values.values()
    if isinstance(to, np.ndarray):
        to[rows] = values
    else:
        for part, value in zip(to, values, strict=True):
            _write(part, rows, value)


def _read(batch, rows) -> object:
    """Returns the rows of a batch of actions."""
    if isinstance(batch, dict):
        return {key: _read(part, rows) for key, part in batch.items()}
    if isinstance(batch, tuple):
        return tuple(_read(part, rows) for part in batch)
    return batch[rows]
