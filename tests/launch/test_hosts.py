"""Runs of two hosts with one torchrun each, and what a broken network, a host that ends, and hosts
that differ do to them.
"""

import os
import signal
import time
from pathlib import Path

import pytest

from megastep.agents.launch.endings import LOST
from megastep.agents.runs import checkpoint, json_lines
from tests.cli.test_exact_resume import differences
from tests.helpers import tiny
from tests.helpers.hosts import INTERFACE, NAMES, descendants, hosts, training
from tests.helpers.processes import HUNG, is_running, wait_until

__all__ = ["hosts"]
pytestmark = pytest.mark.usefixtures("here")
TINY = [*tiny.TINY, "logging.every=1", "folder=run", "checkpoints.seconds=0.5"]
UPDATE = 2 * tiny.UPDATE
CONTINUE = "To continue: python train.py resume=run\n"

#: Trains with deadlines that a test can wait for, once ranks have started, which takes long on a
#: busy machine. Ranks write down the sums of their weights' bits.
HASTY = """
import os, sys
from megastep.agents.cli import train
from megastep.agents.distributed import ranks
from megastep.agents.launch import watch
from megastep.agents.training import trainer

report, watch.PERIOD = trainer.Trainer.report, 0.5

def report_and_note(self):
    report(self)
    sums = ranks.checksums(self.policy.parameters()).tolist()
    with open(f"sums-{os.environ['RANK']}", "a") as file:
        print(self.updates, *sums, file=file)
    watch.LOST_SECONDS, watch.SILENT_SECONDS = 5.0, 9.0

trainer.Trainer.report = report_and_note
sys.exit(train.main(sys.argv[1:]))
"""

LATE = """
import os, sys, time
from megastep.agents.cli import entry
from megastep.agents.launch import watch

if os.environ["RANK"] == "1":
    time.sleep(3600)
watch.START_SECONDS = 8.0
sys.exit(entry.run_command("train"))
"""


def checkpoints(here):
    return checkpoint.list_checkpoints(here / "run" / "checkpoints")


def sums(here):
    """Returns the lines that each rank has written."""
    paths = [here / f"sums-{rank}" for rank in range(2)]
    return [path.read_text().splitlines() if path.exists() else [] for path in paths]


def wait_for_ranks(pids, seconds):
    """Waits until processes have ended. Returns the exit code of the last that its parent has not
    read, and None if all are read.
    """
    deadline = time.monotonic() + seconds
    while any(map(is_running, pids)):
        assert time.monotonic() < deadline, "a rank did not end by itself"
        time.sleep(0.05)
    codes = [None]
    for pid in pids:
        try:
            codes.append(int(Path(f"/proc/{pid}/stat").read_text().split()[-1]) >> 8)
        except (FileNotFoundError, ProcessLookupError):
            continue
    return codes[-1]


@pytest.mark.slow
def test_both_sides_of_a_cut_cable_end(here, hosts):
    (here / "hasty.py").write_text(HASTY)
    with training(hosts, here, *TINY, script="hasty.py") as (first, second):
        wait_until(lambda: checkpoints(here) and min(map(len, sums(here))) > 3, first)
        pids = [pid for process in (first, second) for pid in descendants(process.pid)]
        hosts.cable.loss = 1.0
        code = wait_for_ranks(pids, 60)
        first.wait(timeout=HUNG)
        errors = first.written(1), second.written(1)
        assert second.poll() is not None or code == LOST
    lost = f"train.py: rank 1 on {NAMES[1]} does not answer: "
    silent = f"rank 1 on {NAMES[1]}: train.py: {NAMES[0]}, where torchrun keeps the ranks' store, "
    for error, words in zip(errors, (lost, f"{silent}does not answer: ")):
        (line,) = (line for line in error.splitlines(keepends=True) if words in line)
        assert line.endswith(CONTINUE)
    assert checkpoint.load_latest(here / "run" / "checkpoints").step > 0
    pairs = [*zip(*sums(here))]
    assert all(one == other for one, other in pairs)
    assert len({one.partition(" ")[2] for one, _ in pairs}) == len(pairs) > 3


# ---- What happens to a network, and to hosts ----


def finished(processes):
    """Waits until processes have ended. Returns exit code, stdout and stderr of each."""
    outputs = [process.communicate(timeout=HUNG) for process in processes]
    return [(process.returncode, *texts) for process, texts in zip(processes, outputs)]


def rows(here, folder="run"):
    return json_lines.read(here / folder / "metrics.jsonl")


def wait_for_rows(here, n, process, folder="run"):
    path = here / folder / "metrics.jsonl"
    wait_until(lambda: path.exists() and len(path.read_text().splitlines()) >= n, process)


def whole(path):
    """Returns the state of both ranks in a checkpoint, without the seconds."""
    return [checkpoint.load_latest(path, rank=rank).state | {"seconds": 0} for rank in range(2)]


@pytest.mark.nightly
@pytest.mark.parametrize("seconds, goes_on", [(10, True), (90, False)])
def test_cable_that_is_plugged_in_again(here, hosts, seconds, goes_on):
    """After 10 s the run goes on; after 90 s it has ended, and goes on bit for bit."""
    n = 300
    words = *TINY, f"samples={n * UPDATE}"
    with training(hosts, here, *words, "folder=alone") as processes:
        assert [code for code, *_ in finished(processes)] == [0, 0]
    with training(hosts, here, *words) as processes:
        wait_for_rows(here, 20, processes[0])
        wait_until(lambda: checkpoints(here), processes[0])
        pids = [pid for process in processes for pid in descendants(process.pid)]
        hosts.cable.loss = 1.0
        assert len(rows(here)) < n, "choose more updates"
        time.sleep(seconds)
        hosts.cable.loss = 0.0
        if goes_on:
            assert [code for code, *_ in finished(processes)] == [0, 0]
        else:
            wait_for_ranks(pids, 0.1)
    if not goes_on:
        with training(hosts, here, "resume=run") as processes:
            assert [code for code, *_ in finished(processes)] == [0, 0]
    assert (here / "run/metrics.jsonl").read_bytes() == (here / "alone/metrics.jsonl").read_bytes()
    last = [f"{folder}/checkpoints/step_{n * UPDATE}" for folder in ("run", "alone")]
    assert differences(*map(whole, last)) == []


@pytest.mark.nightly
@pytest.mark.parametrize("number", range(2))
def test_host_whose_processes_are_killed(here, hosts, number):
    with training(hosts, here, *TINY) as processes:
        wait_until(lambda: checkpoints(here), processes[0])
        pids = [descendants(process.pid) for process in processes]
        for pid in [processes[number].pid, *pids[number]]:
            os.kill(pid, signal.SIGKILL)
        wait_for_ranks(pids[1 - number], 60)
        processes[1 - number].wait(timeout=HUNG)
        error = processes[1 - number].written(1)
    assert CONTINUE in error
    assert (NAMES[number] if number == 0 else f"rank 1 on {NAMES[1]} does not answer") in error


@pytest.mark.nightly
def test_folder_that_hosts_do_not_share(here, hosts):
    hosts.run(1, "mount", "-t", "tmpfs", "tmpfs", str(here))
    with training(hosts, here, *TINY) as processes:
        endings = finished(processes)
    assert all(code for code, *_ in endings)
    text = f"The run folder {here / 'run'} of rank 0 is not here; start all ranks in one folder"
    assert sum(error.count(text) for *_, error in endings) == 1
    assert f"rank 1 on {NAMES[1]}: {text}" in endings[0][2] and not (here / "run").exists()


@pytest.mark.nightly
def test_hosts_of_ipv6(here, hosts):
    hosts.table.write_text("::1 localhost\nfd77::1 hosta\nfd77::2 hostb\n")
    for number in range(2):
        hosts.run(number, "ip", "-4", "addr", "flush", "dev", INTERFACE)
    with training(hosts, here, *TINY, f"samples={5 * UPDATE}") as processes:
        endings = finished(processes)
    assert [code for code, *_ in endings] == [0, 0], endings
    assert len(rows(here)) == 5


# ---- Hosts that differ, or do not come ----


@pytest.mark.nightly
def test_rank_that_does_not_start_is_named(here, hosts):
    """Its host's torchrun has started it, and it ends, or hangs, before it can say so."""
    (here / "late.py").write_text(LATE)
    with training(hosts, here, *TINY, script="late.py") as processes:
        endings = finished(processes)
    text = "rank 1 of 2 did not start within 8 s; see what torchrun printed on the other machines"
    assert f"train.py: {text}\n" in endings[0][2] and not (here / "run").exists()
