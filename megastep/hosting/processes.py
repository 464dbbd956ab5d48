"""Gymnasium's environments in worker processes, one per core, which do without PyTorch."""

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

from megastep import workers
from megastep.hosting.env_error import EnvError
from megastep.hosting.hosted import HostedEnvs
from megastep.hosting.probe import Probe, probe
from megastep.types import Tree

#: Seconds in which a worker that is to end may finish what it does.
PATIENCE = 5


class VectorProcesses:
    """N environments in worker processes, with the interface and the numbers of `HostedEnvs`. The
    workers end with :meth:`close`, with this object, or with the process that made it.
    """

    max_episode_steps: int | None = None

    def __init__(self, make: Callable, n_envs: int, seed: int = 0):
        import loky
        from loky.backend import get_context

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
                process = context.Process(  # pyright: ignore[reportAttributeAccessIssue]
                    target=_serve,
                    args=(far_end, make, rows, seed),
                    daemon=True,
                    env=workers.WORKER_ENV,
                )
                process.start()
                far_end.close()
                self.pipes.append(pipe)
                self.processes.append(process)
        self.found = Probe()
        with contextlib.suppress(EnvError):  # which comes in training, too
            # in a worker, since a fault may end the process that it happens in
            (self.found,) = self._ask("probe", n_processes=1)
        (example, *_) = self._ask("begin", found=self.found)
        self.metadata, self.render_mode, *spaces = example
        self.single_observation_space, self.single_action_space = spaces
        self.latest_state: Tree = {}

    def reset(self, *, seed: Sequence[int] | None = None) -> tuple:
        return _joined(self._ask("reset", seed=seed))

    def step(self, actions: Tree) -> tuple:
        return _joined(self._ask("step", actions=actions))

    def start_rendering(self) -> None:
        self.render_mode, *_ = self._ask("start_rendering")

    def render(self) -> list:
        return [frame for frames in self._ask("render") for frame in frames]

    def wrapper_state(self) -> Tree:
        """Returns what the first environment's wrappers have learnt, by path, as last known."""
        with contextlib.suppress(EnvError, MemoryError):
            (self.latest_state,) = self._ask("wrapper_state", n_processes=1)
        return self.latest_state

    def load_wrapper_state(self, state: Tree, is_frozen: bool) -> None:
        self._ask("load_wrapper_state", state=state, is_frozen=is_frozen)

    def close(self) -> None:
        """Closes the environments and ends their processes. Raises the first EnvError."""
        answers, pipes, end = [], [*self.pipes], time.monotonic() + PATIENCE
        for pipe in pipes:
            with contextlib.suppress(EOFError, OSError):  # it has ended
                pipe.send(("close", {}))
        for pipe in pipes:
            with contextlib.suppress(EOFError, OSError):
                if pipe.poll(max(0.0, end - time.monotonic())):
                    answers.append(pipe.recv())
                else:
                    answers.append(EnvError(f"close() did not return in {PATIENCE} s"))
        self._finalizer()
        _raise_first(answers)

    def _ask(self, command, n_processes=None, **arguments) -> list:
        """Returns the answers of processes, or the first's; rows are divided among them."""
        pipes = self.pipes[:n_processes]
        for pipe, rows in zip(pipes, self.rows):
            own = arguments
            if command in ("reset", "step"):
                own = {name: _rows_of(batch, rows) for name, batch in arguments.items()}
            with contextlib.suppress(OSError):  # of a process that has ended, as its answer says
                pipe.send((command, own))
        return _raise_first([self._receive(number) for number in range(len(pipes))])

    def _receive(self, number) -> Any:
        """Returns a process's answer. MemoryError if it was killed, EnvError if it has ended."""
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


def _serve(pipe, make, rows, seed) -> None:
    """Answers commands until the pipe is closed, which it is when the other process ends."""
    global_seed = int(np.random.SeedSequence([seed, rows.start, 2]).generate_state(1)[0])
    np.random.seed(global_seed)  # for what draws too rarely to be found by a probe
    random.seed(global_seed)
    envs: Any = None

    def answer(command, arguments) -> Any:
        nonlocal envs
        if command == "probe":
            return probe(make)
        if command == "begin":
            n_envs = rows.stop - rows.start
            envs = HostedEnvs(make, n_envs, rows.start, seed=seed, **arguments)
            names = "metadata", "render_mode", "single_observation_space", "single_action_space"
            return [getattr(envs, name) for name in names]
        return getattr(envs, command)(**arguments)

    command = None
    with contextlib.suppress(EOFError, OSError):
        while command != "close":
            command, arguments = pipe.recv()
            pipe.send(_attempt(answer, command, arguments))
    if command != "close" and envs is not None:
        _attempt(envs.close)


def _raise_first(answers) -> list:
    for answer in answers:
        if isinstance(answer, Exception):
            raise answer
    return answers


def _attempt(function, *arguments) -> Any:
    """Returns what a function returns, or its error, in a form that can be sent."""
    try:
        return function(*arguments)
    except EnvError as error:
        return error
    except MemoryError as error:
        return MemoryError(*map(str, error.args))
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


def _joined(parts) -> Any:
    """Returns the values of all environments, from those of each process."""
    if isinstance(parts[0], dict):
        return {key: _joined([part[key] for part in parts]) for key in parts[0]}
    if isinstance(parts[0], tuple):
        return tuple(map(_joined, zip(*parts)))
    return np.concatenate(parts)


def _rows_of(batch, rows) -> Any:
    """Returns the rows of a batch of actions or of seeds."""
    if isinstance(batch, dict):
        return {key: _rows_of(part, rows) for key, part in batch.items()}
    if isinstance(batch, tuple):
        return tuple(_rows_of(part, rows) for part in batch)
    return batch if batch is None else batch[rows]
