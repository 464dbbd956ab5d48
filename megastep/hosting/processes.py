"""Steps Gymnasium's environments in worker processes, one per CPU core.

Workers import Gymnasium and what the environments need, but not PyTorch.
"""

import contextlib
import multiprocessing
import os
import random
import signal
import time
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gymnasium.vector.utils import create_empty_array

from megastep import workers
from megastep.hosting.env_error import EnvError
from megastep.hosting.guard import HostedEnvs, start_rendering
from megastep.hosting.probe import Probe, probe
from megastep.types import Tree

__all__ = ["VectorProcesses"]

#: Seconds in which a worker that is to end may finish what it does.
PATIENCE = 5


class VectorProcesses:
    """N environments in worker processes, with the interface of Gymnasium's vector environments.

    Each environment gets the same seed as in one process, so the numbers are the same. The workers
    end with :meth:`close`, with this object, or with the process that made it, even if that is
    killed.

    Args:
        make: makes one environment. It is sent to the workers.
        n_envs: number of environments, N.
        seed: of what the environments draw from global generators.
        settings: others of :class:`~megastep.hosting.guard.HostedEnvs`.
    """

    max_episode_steps: int | None = None

    def __init__(self, make: Callable, n_envs: int, seed: int = 0, **settings: Any):
        import loky
        from loky.backend import get_context

        self.restart_failed = settings.get("restart_failed", 0)
        # one per core, shared among the ranks of a host
        n_processes = loky.cpu_count() // int(os.environ.get("LOCAL_WORLD_SIZE", 1))
        edges = np.linspace(0, n_envs, min(max(n_processes, 1), n_envs) + 1).astype(int).tolist()
        self.rows = [slice(*pair) for pair in zip(edges, edges[1:])]
        self.pipes, self.processes = [], []
        self._finalizer = weakref.finalize(self, _end, self.pipes, self.processes)
        context = get_context("loky")  # a new interpreter: a fork would share locks and threads
        with workers.terminal_signals_blocked():
            for rows in self.rows:
                pipe, far_end = multiprocessing.Pipe()
                worker = _Worker(make, rows, dict(seed=seed, **settings))
                process = context.Process(  # pyright: ignore[reportAttributeAccessIssue]
                    target=worker.serve, args=(far_end,), daemon=True, env=workers.WORKER_ENV
                )
                process.start()
                far_end.close()
                self.pipes.append(pipe)
                self.processes.append(process)
        # in a worker, since a fault may end the process that it happens in
        self.pipes[0].send(("probe", {}))
        self.found = self._receive(0)
        self.found = Probe() if isinstance(self.found, Exception) else self.found
        (example, *_) = self._ask("begin", [{"found": self.found}] * len(self.rows))
        self.metadata, self.render_mode, spaces = example
        self.single_observation_space, self.single_action_space = spaces
        self.observations = create_empty_array(self.single_observation_space, n_envs)
        self.results = np.zeros(n_envs), np.zeros(n_envs, bool), np.zeros(n_envs, bool)
        self.latest_state: Tree = {}

    def reset(self, *, seed: Sequence[int] | None = None) -> tuple[Tree, dict]:
        """Resets every environment. Returns (observations, infos), see `step`."""
        seeds = [{"seed": seed and list(seed[rows])} for rows in self.rows]
        answers = self._ask("reset", seeds)
        for rows, (obs, _) in zip(self.rows, answers):
            _write(self.observations, rows, obs)
        return self.observations, self._merged([infos for _, infos in answers])

    def step(self, actions: Tree) -> tuple:
        """Takes one step. Returns (observations, rewards, terminated, truncated, infos), which are
        valid until the next call.
        """
        answers = self._ask("step", [{"actions": _read(actions, rows)} for rows in self.rows])
        for rows, (obs, *results, _) in zip(self.rows, answers):
            _write(self.observations, rows, obs)
            _write(self.results, rows, results)
        return self.observations, *self.results, self._merged([infos for *_, infos in answers])

    def render(self) -> list:
        """Returns a frame of every environment."""
        answers = self._ask("render", [{}] * len(self.rows))
        return [frame for frames in answers for frame in frames]

    def wrapper_state(self) -> Tree:
        """Returns what the wrappers of the first environment have learnt, by path; of a process
        that has ended, what it was at the last call.
        """
        if self.found.learnt:
            with contextlib.suppress(OSError, EnvError, MemoryError):
                self.pipes[0].send(("wrapper_state", {}))
                answer = self._receive(0)
                if not isinstance(answer, Exception):
                    self.latest_state = answer
        return self.latest_state

    def load_wrapper_state(self, state: Tree, is_frozen: bool) -> None:
        """As :meth:`~megastep.hosting.guard.HostedEnvs.load_wrapper_state`."""
        arguments = dict(state=state, is_frozen=is_frozen)
        self._ask("load_wrapper_state", [arguments] * len(self.rows))

    def close(self) -> None:
        """Closes the environments and ends their processes, by force after `PATIENCE` seconds.

        Raises:
            EnvError: the first error of an environment that could not be closed.
        """
        answers, pipes = [], [*self.pipes]
        for pipe in pipes:
            with contextlib.suppress(EOFError, OSError):  # it has ended
                pipe.send(("close", {}))
        end = time.monotonic() + PATIENCE
        for pipe in pipes:
            with contextlib.suppress(EOFError, OSError):
                if pipe.poll(max(0.0, end - time.monotonic())):
                    answers.append(pipe.recv())
                else:
                    answers.append(EnvError(f"close() did not return in {PATIENCE} s"))
        self._finalizer()
        _raise_first(answers)

    def _ask(self, command, arguments) -> list:
        """Returns the answer of each process to a command."""
        for pipe, own in zip(self.pipes, arguments, strict=True):
            with contextlib.suppress(OSError):  # of a process that has ended, as its answer says
                pipe.send((command, own))
        return _raise_first([self._receive(number) for number in range(len(self.pipes))])

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

    def _merged(self, infos) -> dict[str, np.ndarray]:
        """Returns the infos of all environments."""
        merged = {}
        for rows, own in zip(self.rows, infos):
            for key, values in own.items():
                if key not in merged:
                    shape = self.rows[-1].stop, *values.shape[1:]
                    merged[key] = np.zeros(shape, values.dtype)
                merged[key][rows] = values
        return merged


class _Worker:
    """What a process does: it answers commands until the pipe is closed, which it is when the other
    process ends.
    """

    def __init__(self, make, rows, settings) -> None:
        self.make, self.rows, self.settings = make, rows, settings
        self.envs: Any = None

    def serve(self, pipe) -> None:
        seeds = np.random.SeedSequence([self.settings["seed"], self.rows.start])
        seed = int(seeds.generate_state(1)[0])
        np.random.seed(seed)  # for what draws too rarely to be found by a probe
        random.seed(seed)
        command = None
        with contextlib.suppress(EOFError, OSError):
            while command != "close":
                command, arguments = pipe.recv()
                pipe.send(_attempt(self.answer, command, arguments))
        if command != "close" and self.envs is not None:
            _attempt(self.envs.close)

    def answer(self, command, arguments) -> Any:
        if command == "probe":
            return probe(self.make)
        if command == "begin":
            n_envs, first = self.rows.stop - self.rows.start, self.rows.start
            self.envs = envs = HostedEnvs(self.make, n_envs, first, **arguments, **self.settings)
            spaces = envs.single_observation_space, envs.single_action_space
            return envs.metadata, envs.render_mode, spaces
        if command == "render":
            start_rendering(self.envs)
        return getattr(self.envs, command)(**arguments)


def _raise_first(answers) -> list:
    for answer in answers:
        if isinstance(answer, Exception):
            raise answer
    return answers


def _attempt(function, *arguments) -> Any:
    """Returns what a function returns, or its error, in a form that can be sent."""
    try:
        return function(*arguments)
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
