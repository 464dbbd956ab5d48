"""Two hosts on one machine: namespaces of Linux with names, networks and mounted folders of their
own, and a cable between them that tests cut, delay and make lose packets. Needs root.
"""

import concurrent.futures
import contextlib
import ctypes
import fcntl
import functools
import os
import queue
import random
import select
import shutil
import signal
import struct
import subprocess
import tempfile
import threading
import time
from pathlib import Path

import pytest

from tests.helpers.processes import ROOT, Forked

#: Flags of Linux: what a file of a namespace stands for, and a device of Ethernet frames.
NAMESPACES = {"net": 0x40000000, "uts": 0x04000000, "mnt": 0x00020000}
TUNSETIFF, TAP = 0x400454CA, 0x1002
#: The hosts' names, addresses and interface, and the port where torchrun's meet.
NAMES, ADDRESSES, INTERFACE = ("hosta", "hostb"), ("10.77.0.1", "10.77.0.2"), "eth0"
PORT = 29500


@functools.cache
def problem():
    """Returns why hosts cannot be made here, as a sentence; None if they can."""
    if missing := [name for name in ("ip", "unshare", "nsenter") if shutil.which(name) is None]:
        return f"Hosts need {missing[0]}, of Debian's iproute2 or util-linux."
    try:
        with Hosts():
            return None
    except (OSError, subprocess.CalledProcessError, AttributeError) as error:
        return f"Hosts need root and /dev/net/tun on Linux: {error}."


class Hosts:
    """Two hosts, `hosta` at 10.77.0.1 and fd77::1, and `hostb` at .2 and ::2. A context.

    Attributes:
        cable: the `Cable` between them.
    """

    def __enter__(self):
        with contextlib.ExitStack() as stack:
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            self.table = Path(folder, "hosts")
            names = dict(zip(ADDRESSES, NAMES), **{"127.0.0.1": "localhost"})
            self.table.write_text("".join(f"{one} {name}\n" for one, name in names.items()))
            self.holders = [self._hold(stack, name) for name in NAMES]
            self.cable = stack.enter_context(Cable(self, INTERFACE, "10.77.0", "fd77:"))
            self.stack = stack.pop_all()
        return self

    def __exit__(self, *error):
        self.stack.close()

    def _hold(self, stack, name):
        """Starts a process that keeps a host's namespaces. Returns its number."""
        steps = [
            f"hostname {name}",
            f"mount --bind {self.table} /etc/hosts",
            "mount --bind /dev/null /etc/resolv.conf",
            "ip link set lo up",
            "echo .",
            "exec sleep 3600",
        ]
        words = ["unshare", "--net", "--uts", "--mount", "sh", "-c", " && ".join(steps)]
        holder = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        stack.callback(holder.wait)
        stack.callback(holder.kill)
        if not holder.stdout.read(1):
            raise OSError("unshare failed")
        return holder.pid

    def run(self, number, *words):
        """Runs a command on a host."""
        enters = ["nsenter", f"--target={self.holders[number]}", "--net", "--uts", "--mount"]
        subprocess.run([*enters, *words], check=True, capture_output=True)

    def forked(self, number, *words, cwd=None, **environment):
        """Starts `python *words` on a host, as a `Forked` process."""
        variables = {"GLOO_SOCKET_IFNAME": INTERFACE, "PYTHONPATH": str(ROOT), **environment}
        return Forked(words, cwd, os.environ | variables, self.holders[number])

    def torchrun(self, number, *words, options=(), endpoint=None, cwd=None, **environment):
        """Starts torchrun with one rank on a host, as a `Forked` process.

        Args:
            words: the script and its words.
            options: further ones of torchrun's.
            endpoint: where the hosts meet; default: at the first one.
        """
        options = [
            "--nnodes=2",
            "--nproc-per-node=1",
            "--rdzv-backend=c10d",
            f"--rdzv-endpoint={endpoint or f'{NAMES[0]}:{PORT}'}",
            *options,
        ]
        words = "-m", "torch.distributed.run", *options, *words
        return self.forked(number, *words, cwd=cwd, **environment)


class Cable:
    """Connects two hosts by an interface on each. A context.

    Args:
        hosts: the `Hosts`.
        name: of the interfaces.
        net, net6: first three numbers of their addresses, and what those of IPv6 begin with.

    Attributes:
        delay: seconds that a frame takes from one to the other.
        loss: fraction of frames that are lost; 1 cuts the cable.
    """

    def __init__(self, hosts, name, net, net6):
        self.hosts, self.name, self.nets = hosts, name, (net, net6)
        self.delay = self.loss = 0.0
        self.has_ended = threading.Event()

    def __enter__(self):
        with contextlib.ExitStack() as stack:
            ends = [self._plug_in(stack, number) for number in range(2)]
            for pair in (ends, ends[::-1]):
                carrier = threading.Thread(target=self._carry, args=pair)
                stack.callback(carrier.join)
                carrier.start()
            stack.callback(self.has_ended.set)
            self.stack = stack.pop_all()
        return self

    def __exit__(self, *error):
        self.stack.close()

    def _plug_in(self, stack, number):
        """Makes a host's interface. Returns the file of its end of the cable."""
        holder = self.hosts.holders[number]
        # in a thread, of which a network namespace is
        with concurrent.futures.ThreadPoolExecutor() as pool:
            end = pool.submit(_open_tap, holder, self.name).result()
        stack.callback(os.close, end)
        net, net6 = self.nets
        for words in (
            f"addr add {net}.{number + 1}/24 dev {self.name}",
            f"addr add {net6}:{number + 1}/64 dev {self.name} nodad",
            f"link set {self.name} up",
        ):
            self.hosts.run(number, "ip", *words.split())
        return end

    def _carry(self, source, target):
        """Reads frames at one end and writes them at the other."""
        waiting, draws = queue.SimpleQueue(), random.Random(1)
        due = None
        while not self.has_ended.is_set():
            seconds = 0.05 if due is None else min(0.05, max(0.0, due[0] - time.monotonic()))
            if select.select([source], [], [], seconds)[0]:
                frame = os.read(source, 65536)
                if draws.random() >= self.loss:
                    waiting.put((time.monotonic() + self.delay, frame))
            while due or not waiting.empty():
                due = due or waiting.get()
                if due[0] > time.monotonic():
                    break
                with contextlib.suppress(OSError):
                    os.write(target, due[1])
                due = None


def enter(holder, names=tuple(NAMESPACES)):
    """Moves this process, of one thread, to the host of a holder."""
    for name in names:
        file = os.open(f"/proc/{holder}/ns/{name}", os.O_RDONLY)
        try:
            if ctypes.CDLL(None, use_errno=True).setns(file, NAMESPACES[name]):
                raise OSError(ctypes.get_errno(), "setns failed")
        finally:
            os.close(file)


def _open_tap(holder, name):
    enter(holder, ["net"])
    end = os.open("/dev/net/tun", os.O_RDWR)
    fcntl.ioctl(end, TUNSETIFF, struct.pack("16sH22x", name.encode(), TAP))
    return end


@pytest.fixture
def hosts():
    """Two hosts. Skips the test where none can be made."""
    if reason := problem():
        pytest.skip(reason)
    with Hosts() as hosts:
        yield hosts


def children(pid):
    """Returns the numbers of the processes that a process's main thread started, in order."""
    try:
        return [*map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split())]
    except (FileNotFoundError, ProcessLookupError):
        return []


def descendants(pid):
    """Returns the numbers of all processes below a process."""
    return [child for one in children(pid) for child in [one, *descendants(one)]]


@contextlib.contextmanager
def training(hosts, folder, *words, script=ROOT / "train.py", options=(), endpoint=None, **env):
    """Starts a run with one rank on each host. A context, at whose end none is left.

    Yields:
        The two processes of torchrun.
    """
    processes, ranks = [], []
    try:
        for number in range(len(NAMES)):
            processes.append(
                hosts.torchrun(
                    number, script, *words, options=options, endpoint=endpoint, cwd=folder, **env
                )
            )
        yield processes
    finally:
        for process in processes:
            ranks += descendants(process.pid)
            process.kill()
        for rank in ranks:
            with contextlib.suppress(ProcessLookupError):
                os.kill(rank, signal.SIGKILL)
        for process in processes:
            process.wait()
