"""Runs a command on a Slurm cluster of this machine alone: a login node and two compute nodes, in
namespaces of Linux. Nothing of it is left when the command has ended.

    python scripts/slurm_cluster.py sbatch --wait train.sbatch env=minimal geometry=box samples=1e6

Needs Linux, root, and Debian's `slurm-wlm` and `munge`. The nodes, `nodea` and `nodeb` of the
partition `gpu`, say that they have 64 cores and 8 GPUs each, whatever is there, so that any job
script starts. They share the machine's files and have names and addresses of their own, but no
cables between them: tests/helpers/hosts.py has those.
"""

import argparse
import contextlib
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LOGIN, NODES = "login", ("nodea", "nodeb")
#: Names and addresses, all of them the loopback interface's.
ADDRESSES = {name: f"10.79.0.{number}" for number, name in enumerate((LOGIN, *NODES), 1)}
PROGRAMS = "slurmctld", "slurmd", "sbatch", "munged", "unshare", "nsenter", "ip"
#: Files of munged, which signs the messages of Slurm.
MUNGE_FILES = "key", "log", "seed", "pid"
#: Seconds in which the nodes must be idle.
START_SECONDS = 60.0
#: A requeued job waits for old credentials to expire, by default for two minutes.
CONFIG = """\
ClusterName=megastep
SlurmctldHost={login}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd-%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SlurmdParameters=config_overrides
GresTypes=gpu
ReturnToService=2
SchedulerParameters=bf_interval=2,sched_interval=2
{nodes}
PartitionName=gpu Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def problem() -> str | None:
    """Returns why no cluster can be started here, as a sentence; None if one can."""
    path = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/sbin"])
    if missing := [name for name in PROGRAMS if shutil.which(name, path=path) is None]:
        return f"A Slurm cluster needs {missing[0]}, of Debian's slurm-wlm, munge or util-linux."
    words = ["unshare", "--net", "--uts", "--mount", "--pid", "--fork", "true"]
    if subprocess.run(words, capture_output=True).returncode:
        return "A Slurm cluster needs root, to make namespaces."
    return None


class Cluster:
    """A Slurm cluster. A context, at whose end all of its processes are killed.

    Attributes:
        folder: its configuration and logs.
    """

    def __enter__(self) -> "Cluster":
        with contextlib.ExitStack() as stack:
            self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="slurm-")))
            self._write_files()
            self.holder = self._hold(stack)
            socket = self.folder / "munge.socket"
            files = (f"--{name}-file={self.folder}/munge.{name}" for name in MUNGE_FILES)
            self._start(LOGIN, "munged", "--foreground", f"--socket={socket}", *files)
            self._wait(socket.exists, "munged")
            self._start(LOGIN, "slurmctld", "-D")
            for node in NODES:
                self._start(node, "slurmd", "-D", "-N", node)
            self._wait(self._is_idle, "the nodes")
            self.stack = stack.pop_all()
        return self

    def __exit__(self, *error) -> None:
        self.stack.close()

    def words(self, node: str, *words: str | Path) -> list[str]:
        """Returns what runs a command on a node, from this process's current folder."""
        enters = [f"--target={self.holder}", "--net", "--mount", "--pid", f"--wd={os.getcwd()}"]
        script = f'hostname {node} && exec "$@"'
        return ["nsenter", *enters, "unshare", "--uts", "sh", "-c", script, "sh", *map(str, words)]

    def environment(self) -> dict[str, str]:
        """Returns the environment variables of commands."""
        path = os.pathsep.join([os.environ["PATH"], "/usr/sbin", "/sbin"])
        return {**os.environ, "PATH": path, "SLURM_CONF": str(self.folder / "slurm.conf")}

    def run(self, *words: str | Path, **options) -> subprocess.CompletedProcess:
        """Runs a command on the login node. Options are those of `subprocess.run`."""
        return subprocess.run(self.words(LOGIN, *words), env=self.environment(), **options)

    def read(self, *words: str | Path) -> str:
        """Returns what a command on the login node prints. Raises CalledProcessError."""
        return self.run(*words, check=True, text=True, stdout=subprocess.PIPE).stdout

    def logs(self) -> str:
        """Returns the ends of all logs."""
        paths = sorted(self.folder.glob("*.log"))
        return "\n".join(f"{path.name}: {path.read_text()[-2000:]}" for path in paths)

    def _write_files(self) -> None:
        nodes = [
            f"NodeName={name} NodeAddr={ADDRESSES[name]} NodeHostname={name} Port={6820 + number} "
            "CPUs=64 RealMemory=1024 Gres=gpu:8 State=UNKNOWN"
            for number, name in enumerate(NODES)
        ]
        config = CONFIG.format(
            login=f"{LOGIN}({ADDRESSES[LOGIN]})", folder=self.folder, nodes="\n".join(nodes)
        )
        is_v2 = Path("/sys/fs/cgroup/cgroup.controllers").exists()
        hosts = "".join(f"{address} {name}\n" for name, address in ADDRESSES.items())
        files = {
            "slurm.conf": config,
            "cgroup.conf": f"CgroupPlugin=cgroup/v{1 + is_v2}\n",
            "gres.conf": f"AutoDetect=off\nName=gpu File={self.folder}/gpu[0-7]\n",
            **{f"gpu{number}": "" for number in range(8)},
            "hosts": f"127.0.0.1 localhost\n{hosts}",
        }
        for name, text in files.items():
            (self.folder / name).write_text(text)
        key = self.folder / "munge.key"
        key.touch(mode=0o600)
        key.write_bytes(secrets.token_bytes(128))
        for name in ("state", *(f"spool-{node}" for node in NODES)):
            (self.folder / name).mkdir()
        self.folder.chmod(0o755)  # munged asks for it

    def _hold(self, stack) -> int:
        """Starts the process that keeps the namespaces; they end with it. Returns its id."""
        steps = [
            "ip link set lo up",
            *(f"ip addr add {address}/32 dev lo" for address in ADDRESSES.values()),
            f"mount --bind {self.folder / 'hosts'} /etc/hosts",
            "mount --bind /dev/null /etc/resolv.conf",
            "echo .",
            "exec sleep infinity",
        ]
        words = "unshare --net --uts --mount --pid --fork --kill-child --mount-proc sh -c".split()
        parent = subprocess.Popen([*words, " && ".join(steps)], stdout=subprocess.PIPE)
        stack.callback(parent.wait)
        stack.callback(parent.kill)
        assert parent.stdout is not None
        if not parent.stdout.read(1):
            raise OSError("unshare failed")
        return int(Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text())

    def _start(self, node, *words) -> None:
        with open(self.folder / f"{words[0]}-{node}.out.log", "w") as log:
            subprocess.Popen(
                self.words(node, *words),
                env=self.environment(),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def _is_idle(self) -> bool:
        words = "sinfo", "--noheader", "--Node", "--format=%T"
        states = self.run(*words, text=True, capture_output=True).stdout.split()
        return states == ["idle"] * len(NODES)

    def _wait(self, is_ready, what) -> None:
        deadline = time.monotonic() + START_SECONDS
        while not is_ready():
            if time.monotonic() > deadline:
                raise TimeoutError(f"{what} did not start in {START_SECONDS:.0f} s\n{self.logs()}")
            time.sleep(0.2)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("command", nargs=argparse.REMAINDER, help="what to run on the login node")
    options = parser.parse_args()
    if reason := problem():
        print(reason, file=sys.stderr)
        return 2
    with Cluster() as cluster:
        return cluster.run(*(options.command or ["sinfo"])).returncode


if __name__ == "__main__":
    raise SystemExit(main())
