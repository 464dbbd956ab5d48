"""Starts ranks as torchrun does: processes with its environment variables, on CPUs."""

import contextlib
import inspect
import os
import pickle
import socket
import subprocess
import sys
import time
from pathlib import Path

from tests.helpers.processes import Forked

ROOT = Path(__file__).parents[2]
#: Seconds after which ranks count as hung: ten times what they need on two busy cores.
HUNG = 180


@contextlib.contextmanager
def started(words, n_ranks=2, **env):
    """Starts `python *words` in R `Forked` processes. A context, at whose end none is left.

    Args:
        words: of the command line, such as `[ROOT / "train.py", "env=minimal"]`.
        env: environment variables besides torchrun's.

    Yields:
        The processes.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": f"{ROOT}"} | env
    shared |= dict(MASTER_ADDR="127.0.0.1", MASTER_PORT=f"{port}", WORLD_SIZE=f"{n_ranks}")
    shared |= dict(LOCAL_WORLD_SIZE=f"{n_ranks}", GLOO_SOCKET_IFNAME="lo")
    processes = []
    try:
        for rank in range(n_ranks):
            own = shared | {"RANK": f"{rank}", "LOCAL_RANK": f"{rank}"}
            processes.append(Forked(words, None, own))
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.wait()


def finished(processes, seconds=HUNG):
    """Waits for processes. Returns a CompletedProcess of each.

    Raises:
        subprocess.TimeoutExpired: one hangs.
    """
    deadline = time.monotonic() + seconds
    results = []
    for process in processes:
        stdout, stderr = process.communicate(timeout=max(0.1, deadline - time.monotonic()))
        results.append(
            subprocess.CompletedProcess(process.args, process.returncode, stdout, stderr)
        )
    return results


def run(words, n_ranks=2, seconds=HUNG, **env):
    """Runs `python *words` in R processes. Returns a CompletedProcess of each."""
    with started(words, n_ranks, **env) as processes:
        return finished(processes, seconds)


def train(*words, n_ranks=2, **env):
    """Trains with R ranks, each with these words of the command line. Returns a CompletedProcess of
    each, all with exit code 0.
    """
    results = run([ROOT / "train.py", *words], n_ranks, **env)
    assert not any(result.returncode for result in results), [one.stderr for one in results]
    return results


def call(function, *arguments, n_ranks=2, **env):
    """Calls a function of a module in R processes that have joined. Returns what each returns.

    Args:
        arguments: can be pickled, as must be what is returned.
    """
    # pytest imports a file of tests under its bare name
    path = Path(inspect.getfile(function)).relative_to(ROOT).with_suffix("")
    name = f"{'.'.join(path.parts)}:{function.__qualname__}"
    words = ["-m", "tests.helpers.ranks", name, pickle.dumps(arguments).hex()]
    results = run(words, n_ranks, **env)
    assert not any(result.returncode for result in results), [one.stderr for one in results]
    return [pickle.loads(bytes.fromhex(one.stdout.split()[-1])) for one in results]


def _main(name, arguments):
    """Calls a function in this process, which `call` has started, and prints what it returns."""
    import importlib

    from megastep.agents.distributed import process_group

    module, _, function = name.partition(":")
    process_group.start()
    try:
        function = getattr(importlib.import_module(module), function)
        value = function(*pickle.loads(bytes.fromhex(arguments)))
    finally:
        process_group.stop()
    print(pickle.dumps(value).hex())


if __name__ == "__main__":
    _main(*sys.argv[1:])
