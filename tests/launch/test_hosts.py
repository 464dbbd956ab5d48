"""Runs of two hosts with one torchrun each, and what a broken network, a host that ends, and hosts
that differ do to them.
"""

import time
from pathlib import Path

import pytest

from megastep.agents.launch import launcher
from megastep.agents.runs import checkpoint
from tests.helpers import tiny
from tests.helpers.hosts import NAMES, descendants, hosts, training
from tests.helpers.processes import HUNG, is_running, wait_until

__all__ = ["hosts"]
pytestmark = pytest.mark.usefixtures("here")
TINY = [*tiny.TINY, "log_every=1", "folder=run", "checkpoint_seconds=0.5"]
CONTINUE = "Its last checkpoint is intact. To continue: python train.py resume=run\n"

#: Trains with deadlines that a test can wait for, once ranks have started, which takes long on a
#: busy machine. Ranks write down the sums of their weights' bits.
HASTY = """
import os, sys
from megastep.agents.cli import train
from megastep.agents.distributed import drift
from megastep.agents.launch import watch
from megastep.agents.training import trainer

log, watch.PERIOD = trainer.Trainer.log, 0.5

def log_and_tell(self, losses):
    log(self, losses)
    sums = drift.checksums(self.policy.parameters()).tolist()
    with open(f"sums-{os.environ['RANK']}", "a") as file:
        print(self.updates, *sums, file=file)
    watch.LOST_SECONDS, watch.SILENT_SECONDS = 5.0, 9.0

trainer.Trainer.log = log_and_tell
sys.exit(train.main(sys.argv[1:]))
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
        hosts.loss = 1.0
        code = wait_for_ranks(pids, 60)
        first.wait(timeout=HUNG)
        errors = first.written(1), second.written(1)
        assert second.poll() is not None or code == launcher.LOST
    lost = f"train.py: rank 1 on {NAMES[1]} does not answer: "
    silent = f"rank 1 on {NAMES[1]}: train.py: {NAMES[0]}, where torchrun keeps the ranks' store, "
    for error, words in zip(errors, (lost, f"{silent}has not answered for ")):
        (line,) = (line for line in error.splitlines(keepends=True) if words in line)
        assert line.endswith(CONTINUE)
    assert checkpoint.load_latest(here / "run" / "checkpoints").step > 0
    pairs = [*zip(*sums(here))]
    assert all(one == other for one, other in pairs)
    assert len({one.partition(" ")[2] for one, _ in pairs}) == len(pairs) > 3
