"""Starts scripts and threads, and waits for them, however slow the machine is."""

import multiprocessing
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

#: Seconds after which a process counts as hung: a hundred times what it needs.
HUNG = 1200


ROOT = Path(__file__).parents[2]


def start(script, *words, cwd=None, **environment):
    """Starts a script with pipes for stdout and stderr, in a session of its own."""
    return subprocess.Popen(
        [sys.executable, str(ROOT / f"{script}.py"), *words],
        cwd=cwd,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, **environment},
        start_new_session=True,
        # where the tests themselves run under nohup
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    )


def finished(script, *words, cwd=None, **environment):
    """Runs a script. Returns (exit code, stdout, stderr)."""
    process = start(script, *words, cwd=cwd, **environment)
    out, err = process.communicate(timeout=HUNG)
    return process.returncode, out, err


#: Forks processes from one that has imported these packages, which takes most of a short run.
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(
    ["torch.utils.tensorboard", "torch.distributed", "matplotlib.pyplot", "hydra", "pydantic"]
)


class Forked:
    """A script in a process of its own that has imported PyTorch when it starts, so it takes a
    third of the time of `start`. Has those members of `subprocess.Popen` that tests use.

    Not for what an interpreter reads when it starts, such as variables of Python and OpenMP, nor
    for signals during imports and processes that the script starts itself.

    Args:
        argv: the script or, after "-m", a module, and its words.
        cwd: the folder to run it in.
        environment: all environment variables.
        holder: number of a process, to run it on its host, see `hosts`; default: this one.
    """

    def __init__(self, argv, cwd, environment, holder=None):
        self.args = [*map(str, argv)]
        self.outputs = [tempfile.NamedTemporaryFile("r") for _ in range(2)]
        names = [file.name for file in self.outputs]
        arguments = self.args, str(cwd or os.getcwd()), environment, names, holder
        self.process = FORKS.Process(target=_run, args=arguments)
        self.process.start()
        self.pid = self.process.pid

    def poll(self):
        return self.process.exitcode

    @property
    def returncode(self):
        return self.process.exitcode

    def wait(self, timeout=None):
        self.process.join(timeout)
        if self.process.exitcode is None:
            raise subprocess.TimeoutExpired(self.args, timeout)
        return self.process.exitcode

    def communicate(self, timeout=None):
        """Waits until it ends. Returns all of stdout and stderr."""
        self.wait(timeout)
        return self.written(0), self.written(1)

    def written(self, number=0):
        """Returns what it has written so far, by default to stdout."""
        return Path(self.outputs[number].name).read_text()

    def send_signal(self, number):
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self):
        self.process.kill()


def _run(argv, folder, environment, outputs, holder):
    os.setsid()
    if holder is not None:
        from tests.helpers import hosts

        hosts.enter(holder)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    for number, (path, name) in enumerate(zip(outputs, ("stdout", "stderr")), 1):
        os.dup2(os.open(path, os.O_WRONLY | os.O_APPEND), number)
        file = open(number, "w", buffering=1, closefd=False)
        setattr(sys, name, file)
        setattr(sys, f"__{name}__", file)
    sys.path.insert(0, str(ROOT))
    if argv[0] == "-m":
        sys.argv = argv[1:]
        runpy.run_module(argv[1], run_name="__main__", alter_sys=True)
    else:
        sys.argv = argv
        runpy.run_path(argv[0], run_name="__main__")


def forked(script, *words, cwd=None, **environment):
    """Starts a script as `start` does, in a `Forked` process."""
    return Forked([ROOT / f"{script}.py", *words], cwd, {**os.environ, **environment})


def wait_until(condition, process):
    """Waits until `condition()` holds. Raises AssertionError with the process's output if it ends
    or hangs before.
    """
    deadline = time.monotonic() + HUNG
    while not condition():
        if process.poll() is not None or time.monotonic() > deadline:
            process.kill()
            raise AssertionError(process.communicate())
        time.sleep(0.02)


def is_running(pid):
    """Returns whether a process exists, and is not a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
