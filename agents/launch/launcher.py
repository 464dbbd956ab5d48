"""Starts the ranks of `ranks=2` on this machine and waits for them.

This process writes the checked settings to a temporary *job folder*, in which ranks write how they
ended. It alone prints errors and forwards signals, and keeps the store of the ranks.
"""

import contextlib
import datetime
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import uuid
from pathlib import Path

from megastep.agents import console, package
from megastep.agents.distributed import environment
from megastep.agents.errors import ConfigErrors, UserError, user_errors
from megastep.agents.factory import check, settings
from megastep.agents.launch import endings, gpu, signals
from megastep.agents.runs import folders, typed_json

ADDRESS = "127.0.0.1"
#: Code that runs a rank. Modules in the current folder must not shadow Python's own.
CODE = """import signal, sys
signal.signal(signal.SIGINT, signal.SIG_DFL)
sys.path[:] = filter(None, sys.path)
from megastep.agents.launch import train
sys.exit(train.run_rank())"""


def n_ranks(cfg: settings.Train) -> int:
    """Returns the number of ranks of a run. ConfigErrors if there is not a GPU for each."""
    if cfg.ranks == 1:
        return 1
    n_gpus = gpu.count() if cfg.device != "cpu" else 0
    if ":" in cfg.device:
        text = f"{cfg.device!r} names one GPU, but every rank needs its own; use device=cuda"
        raise ConfigErrors([("device", text)])
    if cfg.ranks == "all":
        if not n_gpus:
            where = "device=cpu" if cfg.device == "cpu" else "this machine has none"
            text = f"'all' uses every GPU, but {where}; give a number, such as ranks=2"
            raise ConfigErrors([("ranks", text)])
        return n_gpus
    wanted = int(cfg.ranks)
    if n_gpus and wanted > n_gpus and environment.rank_info() is None:
        n_here = f"{n_gpus} GPU{'s' * (n_gpus > 1)}"
        text = f"{wanted} is more than the {n_here} of this machine; ranks=all uses each GPU once"
        raise ConfigErrors([("ranks", text)])
    return wanted


def is_needed(cfg: settings.Train) -> bool:
    """Returns True if this process has to start ranks instead of training itself."""
    return environment.rank_info() is None and cfg.ranks != 1


def run(cfg: settings.Train) -> Path:
    """Trains with several ranks. Returns the run folder. Raises as training in this process."""
    cfg = settings.changed(cfg, ranks=n_ranks(cfg))
    with tempfile.TemporaryDirectory(prefix="megastep-") as folder:
        job = Job(Path(folder), cfg)
        with (
            signals.handled(job.stop, job.quit) as numbers,
            user_errors("The ranks cannot be started: ", (OSError,)),
        ):
            ending = job.run()
    if numbers:
        by_signal = ending.code == 128 + numbers[0]
        name = signal.Signals(numbers[0]).name
        raise signals.Interrupted(numbers[0], ending.text if by_signal else f"stopped by {name}")
    if ending.code > 128:
        raise signals.Interrupted(ending.code - 128, ending.text)
    if ending.code:
        raise UserError(ending.text, ending.code)
    return Path(str(ending.folder))


class Job:
    """The ranks of one training run, whose `ranks` is a number, and their job folder."""

    def __init__(self, folder: Path, cfg: settings.Train):
        self.folder, self.n_ranks, self.is_stopped = folder, int(cfg.ranks), False
        self.processes: list[subprocess.Popen] = []
        facts = dict(
            settings=check.as_tree(cfg),
            argv=sys.argv,
            command=sys.orig_argv,
            prefix=console.prefix,
            parent=os.getpid(),
        )
        (folder / endings.SETTINGS).write_text(typed_json.dumps(facts))

    def run(self) -> endings.Ending:
        """Trains with several ranks. Returns the run folder. Raises as training in this process."""
        listener, failure = socket.create_server((ADDRESS, 0)), None
        shared = os.environ | variables(self.folder, self.n_ranks)
        shared |= {"MASTER_PORT": f"{listener.getsockname()[1]}"}
        with signals.deferred():
            for number in map(str, range(self.n_ranks)):
                env = shared | dict(RANK=number, LOCAL_RANK=number)
                words = [sys.executable, "-c", CODE]
                self.processes.append(subprocess.Popen(words, env=env, start_new_session=True))
        from torch import distributed  # while the ranks import modules

        store = distributed.TCPStore(  # pyright: ignore[reportPrivateImportUsage]
            *listener.getsockname(),
            is_master=True,
            timeout=datetime.timedelta(seconds=300),
            wait_for_workers=False,
            master_listen_fd=listener.detach(),
        )  # answers as long as it lives
        while True:
            codes = [process.poll() for process in self.processes]
            failure = failure or next(((n, code) for n, code in enumerate(codes) if code), None)
            if None not in codes:
                break
            if failure and not self.is_stopped:
                self.send(signal.SIGKILL)
            time.sleep(0.1)
        del store
        return self.ending(failure or (0, 0))

    def stop(self, number: int) -> None:
        """Forwards a signal to the ranks."""
        self.is_stopped = True
        self.send(number)

    def quit(self, number: int) -> None:
        """Kills all ranks and deletes the job folder."""
        self.send(signal.SIGKILL)
        shutil.rmtree(self.folder, ignore_errors=True)

    def send(self, number: int) -> None:
        for process in self.processes:
            process.send_signal(number)

    def ending(self, failure: tuple[int, int]) -> endings.Ending:
        """Returns what a rank wrote about its ending, else what the first failed exit code says."""
        with contextlib.suppress(FileNotFoundError):
            return endings.Ending(*json.loads((self.folder / endings.ENDING).read_text()))
        number, code = failure
        text = f"ended with exit code {code}"
        if code < 0:
            name = signal.Signals(-code).name
            text = f"was killed by {name}" + ", perhaps out of memory" * (name == "SIGKILL")
        path = self.folder / endings.RUN
        hint = folders.to_continue(Path(path.read_text()) if path.exists() else None)
        label = f"rank {number} on {environment.hostname()}"
        return endings.Ending(endings.LOST, f"{label} {text}. {hint}")


def variables(job: Path, n_ranks: int) -> dict[str, str]:
    """Returns the environment variables that all ranks on this machine have beside its own."""
    changes = {
        endings.JOB: str(job),
        "WORLD_SIZE": str(n_ranks),
        "LOCAL_WORLD_SIZE": str(n_ranks),
        "MASTER_ADDR": ADDRESS,
        "TORCHELASTIC_RUN_ID": uuid.uuid4().hex,
        "TORCHELASTIC_USE_AGENT_STORE": "True",
    }
    if (package.ROOT / "train.py").exists():  # a checkout, which may not be installed
        paths = filter(None, [str(package.ROOT), os.environ.get("PYTHONPATH")])
        changes["PYTHONPATH"] = os.pathsep.join(paths)
    # a Slurm job may use only some of the machine's cores
    is_linux = hasattr(os, "sched_getaffinity")
    n_cores = len(os.sched_getaffinity(0)) if is_linux else os.cpu_count() or 1
    defaults = {"OMP_NUM_THREADS": str(max(1, n_cores // n_ranks)), "TORCH_CPP_LOG_LEVEL": "ERROR"}
    if os.path.exists("/sys/class/net/lo"):  # works even if the host name does not resolve
        defaults["GLOO_SOCKET_IFNAME"] = "lo"
    return changes | {name: text for name, text in defaults.items() if name not in os.environ}
