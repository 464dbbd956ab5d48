"""Steps Gymnasium's environments in worker processes, one per CPU core.

Workers import Gymnasium and what the environments need, but not PyTorch.
"""

import contextlib
import multiprocessing
import os
import sys
import traceback
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from megastep import workers

__all__ = ["VectorProcesses", "start_rendering"]

#: Seconds in which a worker that is to end may finish what it does.
PATIENCE = 5


class VectorProcesses:
    """N environments in worker processes, with the interface of Gymnasium's vector environments.

    Each environment gets the same seed as in one process, so the numbers are the same. The workers
    end with :meth:`close`, with this object, or with the process that made it, even if that is
    killed.

    Args:
        make: ``make(num_envs=n)`` returns a ``SyncVectorEnv``. It is sent to the workers.
        n_envs: number of environments, N.
        n_processes: number of processes. Default: one per core, shared among the ranks of a host.
    """

    def __init__(self, make: Callable, n_envs: int, n_processes: int | None = None):
        import loky
        from gymnasium.vector.utils import create_empty_array
        from loky.backend import get_context

        if n_processes is None:
            n_processes = loky.cpu_count() // int(os.environ.get("LOCAL_WORLD_SIZE", 1))
        example = make(num_envs=1)
        self.metadata, self.render_mode = example.metadata, example.render_mode
        self.single_observation_space = example.single_observation_space
        self.single_action_space = example.single_action_space
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
                process = context.Process(
                    target=_serve,
                    args=(far_end, make, rows.stop - rows.start),
                    daemon=True,
                    env=workers.WORKER_ENV,
                )
                process.start()
                far_end.close()
                self.pipes.append(pipe)
                self.processes.append(process)

    def reset(self, *, seed: Sequence[int] | None = None) -> tuple[Any, dict]:
        """Resets every environment. Returns (observations, no infos)."""
        seeds = [None if seed is None else list(seed[rows]) for rows in self.rows]
        for rows, obs in zip(self.rows, self._ask("reset", seeds)):
            _write(self.observations, rows, obs)
        return self.observations, {}

    def step(self, actions: Any) -> tuple[Any, ...]:
        """Takes one step. Returns (observations, rewards, terminated, truncated, no infos), which
        are valid until the next call.
        """
        answers = self._ask("step", [_read(actions, rows) for rows in self.rows])
        for rows, (obs, *results) in zip(self.rows, answers):
            _write(self.observations, rows, obs)
            _write(self.results, rows, results)
        return self.observations, *self.results, {}

    def render(self) -> list[Any]:
        """Returns a frame of every environment."""
        return [frame for frames in self._ask("render", self.rows) for frame in frames]

    def close(self) -> None:
        """Ends the processes."""
        self._finalizer()

    def _ask(self, command, arguments):
        """Returns the answer of each process to a command."""
        answers = []
        try:
            for pipe, argument in zip(self.pipes, arguments, strict=True):
                pipe.send((command, argument))
            answers = [pipe.recv() for pipe in self.pipes]
        except (EOFError, OSError):
            raise MemoryError(
                "a process that steps environments was killed, perhaps because memory ran out"
            ) from None
        for error in answers:
            if isinstance(error, str):
                raise RuntimeError(f"an environment failed in its process:\n{error}")
        return answers


def start_rendering(vector: Any) -> None:
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


def _serve(pipe, make, n_envs):
    """Answers commands until the pipe is closed, which it is when the other process ends."""
    with contextlib.suppress(EOFError, OSError):
        try:
            envs = make(num_envs=n_envs)
            while True:
                command, argument = pipe.recv()
                if command == "reset":
                    pipe.send(envs.reset(seed=argument)[0])
                elif command == "step":
                    pipe.send(envs.step(argument)[:4])
                else:
                    start_rendering(envs)
                    pipe.send(envs.render())
        except (EOFError, OSError):
            envs.close()
            raise
        except Exception:
            pipe.send(traceback.format_exc())


def _end(pipes, processes):
    for pipe in pipes:
        pipe.close()
    for process in processes:
        process.join(PATIENCE)
        if process.is_alive():
            process.kill()
            process.join()


def _write(to, rows, values):
    """Copies the values of some environments into the batch of all."""
    if isinstance(to, dict):
        to, values = to.values(), values.values()
    if isinstance(to, np.ndarray):
        to[rows] = values
    else:
        for part, value in zip(to, values, strict=True):
            _write(part, rows, value)


def _read(batch, rows):
    """Returns the rows of a batch of actions."""
    if isinstance(batch, dict):
        return {key: _read(part, rows) for key, part in batch.items()}
    if isinstance(batch, tuple):
        return tuple(_read(part, rows) for part in batch)
    return batch[rows]
