"""Starts the ranks of `ranks=2` on this machine with torchrun's library and waits for them.

This process composes and checks the settings once and writes them to a temporary *job folder*.
Each rank reads them there, and leaves its process id and its ending in the same folder. Only this
process prints errors and forwards signals; its exit code is that of a run in one process.

torchrun's agent runs in a thread, where it cannot handle signals itself: it would kill ranks that
take more than 30 s to save.
"""

import contextlib
import logging
import os
import shutil
import signal
import sys
import tempfile
import threading
import uuid
from pathlib import Path

from megastep.agents import console, package
from megastep.agents.distributed import environment
from megastep.agents.errors import ConfigErrors, shortened
from megastep.agents.factory import check, settings
from megastep.agents.launch import gpu, signals
from megastep.agents.launch.endings import Ending
from megastep.agents.runs import checkpoint, folders, populations, typed_json

#: Environment variable with the job folder, set for ranks that this module started.
JOB = "MEGASTEP_JOB"
#: Files of the job folder: settings; a mark that the user stopped the job; the run folder's path.
SETTINGS, STOPPED, RUN = "settings.json", "stopped", "run"
#: Exit code if a rank was killed, hangs or cannot be reached.
LOST = 3
#: Code that runs a rank. Modules in the current folder must not shadow Python's own.
RANK = """import sys
sys.path[:] = filter(None, sys.path)
from megastep.agents.launch import rank_process
sys.exit(rank_process.main())"""


def n_ranks(cfg: settings.Train) -> int:
    """Returns the number of ranks of a training run.

    Raises:
        ConfigErrors: there is not a GPU for every rank.
    """
    if cfg.ranks == 1:
        return 1
    info, n_gpus = environment.rank_info(), gpu.count() if cfg.device != "cpu" else 0
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
    if n_gpus and wanted > n_gpus and info is None:
        n_here = f"{n_gpus} GPU{'s' * (n_gpus > 1)}"
        text = f"{wanted} is more than the {n_here} of this machine; ranks=all uses each GPU once"
        raise ConfigErrors([("ranks", text)])
    return wanted


def is_needed(cfg: settings.Train) -> bool:
    """Returns True if this process has to start ranks instead of training itself."""
    return environment.rank_info() is None and (cfg.ranks != 1 or cfg.restarts > 0)


def run(cfg: settings.Train) -> Path:
    """Trains with several ranks. Returns the run folder.

    Raises:
        UserError, Interrupted: as for training in this process.
    """
    cfg = settings.changed(cfg, ranks=n_ranks(cfg))
    with contextlib.ExitStack() as stack:
        job = Job(Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="megastep-"))), cfg)
        stack.enter_context(environment.variables(variables(job.folder, int(cfg.ranks))))
        agent = threading.Thread(target=job.run_agent, daemon=True)
        with signals.handled(job.stop, job.quit) as numbers:
            agent.start()
            while agent.is_alive():
                agent.join(0.2)
                job.poll()
        ending = job.ending()
    if numbers:
        by_signal = ending.code == 128 + numbers[0]
        name = signal.Signals(numbers[0]).name
        raise signals.Interrupted(numbers[0], ending.text if by_signal else f"stopped by {name}")
    ending.raise_error()
    assert ending.folder is not None
    return Path(ending.folder)


class Job:
    """The ranks of one training run.

    Args:
        folder: the job folder, a temporary one.
        cfg: settings; `ranks` is a number.

    Attributes:
        attempt: how often torchrun has restarted the ranks.
        cleared: attempts whose remaining ranks were killed after a loss.
        error: the error of torchrun's agent, if any.
    """

    def __init__(self, folder: Path, cfg: settings.Train):
        self.folder, self.cfg = folder, cfg
        self.attempt, self.error = 0, None
        self.cleared: set[int] = set()
        facts = dict(
            settings=check.as_tree(cfg),
            argv=sys.argv,
            command=sys.orig_argv,
            prefix=console.prefix,
            parent=os.getpid(),
        )
        (folder / SETTINGS).write_text(typed_json.dumps(facts))

    def run_agent(self) -> None:
        """Runs torchrun's agent until all ranks have ended."""
        try:
            launch_ranks(int(self.cfg.ranks), self.cfg.restarts)
        except BaseException as error:
            self.error = error

    def stop(self, number: int) -> None:
        """Forwards a signal to the ranks. Ranks that start later exit at once."""
        (self.folder / STOPPED).touch()
        self.poll()
        self.send(number)

    def quit(self, number: int) -> None:
        """Kills all ranks and deletes the job folder."""
        self.send(signal.SIGKILL)
        shutil.rmtree(self.folder, ignore_errors=True)

    def send(self, number: int) -> None:
        for path in self.folder.glob(f"pid-{self.attempt}-*"):
            with contextlib.suppress(OSError, ValueError):  # it has ended, or is writing its id
                os.kill(int(path.read_text()), number)

    def poll(self) -> None:
        """Once a rank is lost, kills the others at once (torchrun would give them 30 s). Warns when
        torchrun restarts the ranks.
        """
        ending = self.ending_of(self.attempt)
        if ending and ending.code == LOST and self.attempt not in self.cleared:
            self.cleared.add(self.attempt)
            self.send(signal.SIGKILL)
        if [*self.folder.glob(f"pid-{self.attempt + 1}-*")]:
            ending = self.ending_of(self.attempt)
            if ending is None or ending.code > 128:  # torchrun's signal to the remaining ranks
                problem = "A rank was killed or ended without a message"
            else:
                problem = ending.text.partition(" To continue: ")[0]
            self.attempt += 1
            again = f"Restarting, {self.attempt} of restarts={self.cfg.restarts}."
            console.warn(f"{problem.rstrip('.')}. {again}")

    def ending(self) -> Ending:
        """Returns how the ranks ended."""
        ending, failures = self.ending_of(self.attempt), getattr(self.error, "failures", None)
        is_stopped = (self.folder / STOPPED).exists()
        if ending and ending.code > 128 and failures and not is_stopped:
            ending = None  # it reports torchrun's signal to the remaining ranks, not the failure
        return ending or self.unknown_ending()

    def ending_of(self, attempt: int) -> Ending | None:
        path = self.folder / f"ending-{attempt}"
        return Ending.read(path) if path.exists() else None

    def unknown_ending(self) -> Ending:
        """Returns the ending of ranks that wrote none, from the exit codes that torchrun saw."""
        failures = getattr(self.error, "failures", {})
        for rank, failure in failures.items():
            if failure.exitcode < 0:
                name = signal.Signals(-failure.exitcode).name
                text = f"was killed by {name}" + ", perhaps out of memory" * (name == "SIGKILL")
            else:
                text = f"ended with exit code {failure.exitcode}"
            label = f"rank {rank} on {environment.hostname()}"
            return Ending(LOST, f"{label} {text}. {hint(self.run_folder())}")
        reason = shortened(self.error or "they ended without a message", 400)
        return Ending(2, f"The ranks cannot be started: {reason}")

    def run_folder(self) -> Path | None:
        path = self.folder / RUN
        return Path(path.read_text()) if path.exists() else None


def hint(folder: Path | None) -> str:
    """Returns how to continue a run whose ranks were lost in the middle of an update."""
    runs = () if folder is None else populations.members(folder) or [folder]
    if folder is None or not all(checkpoint.list_checkpoints(run / "checkpoints") for run in runs):
        return "Nothing was saved yet"
    return f"Its last checkpoint is intact. To continue: {folders.resume_command(folder)}"


def launch_ranks(n_ranks: int, n_restarts: int) -> None:
    """Runs torchrun's agent until all ranks have ended.

    Args:
        n_ranks: processes to start.
        n_restarts: how often all ranks are restarted after a failure.

    Raises:
        torch.distributed.elastic.multiprocessing.errors.ChildFailedError: a rank failed.
    """
    from torch.distributed.elastic.multiprocessing import DefaultLogsSpecs
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    from megastep.agents.launch import loopback

    loopback.register()
    # its messages repeat the ranks' errors, which are reported in one sentence
    logger = logging.getLogger("torch.distributed")
    logger.handlers, logger.propagate = [logging.NullHandler()], False
    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=n_ranks,
        run_id=uuid.uuid4().hex,
        rdzv_backend=loopback.BACKEND,
        local_addr=loopback.ADDRESS,
        max_restarts=n_restarts,
        monitor_interval=0.1,
        logs_specs=DefaultLogsSpecs(log_dir=os.devnull),
    )
    elastic_launch(config, sys.executable)("-c", RANK)


def variables(job: Path, n_ranks: int) -> dict[str, str]:
    """Returns the environment variables for ranks on this machine."""
    changes = {JOB: str(job)}
    if (package.ROOT / "train.py").exists():  # a checkout, which may not be installed
        paths = filter(None, [str(package.ROOT), os.environ.get("PYTHONPATH")])
        changes["PYTHONPATH"] = os.pathsep.join(paths)
    # a Slurm job may use only some of the machine's cores
    is_linux = hasattr(os, "sched_getaffinity")
    n_cores = len(os.sched_getaffinity(0)) if is_linux else os.cpu_count() or 1
    defaults = {
        "OMP_NUM_THREADS": str(max(1, n_cores // n_ranks)),
        "TORCH_CPP_LOG_LEVEL": "ERROR",
    }
    if os.path.exists("/sys/class/net/lo"):  # works even if the host name does not resolve
        defaults["GLOO_SOCKET_IFNAME"] = "lo"
    return changes | {name: text for name, text in defaults.items() if name not in os.environ}
