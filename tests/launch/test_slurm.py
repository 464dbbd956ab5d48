"""Jobs of a real Slurm with two nodes: docs/scaling.md's script and sweeps."""

import csv
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
import slurm_cluster

from megastep.agents.runs import checkpoint, json_lines
from tests.cli.test_exact_resume import differences
from tests.helpers import tiny
from tests.helpers.processes import HUNG, ROOT

pytestmark = pytest.mark.nightly
#: Updates that take long enough to be interrupted.
N = 100
WORDS = [*tiny.TINY, "logging.every=1", "checkpoints.seconds=0.5"]
SAMPLES = f"samples={2 * N * tiny.UPDATE}"
#: Seconds before its time limit at which a job gets a signal, or up to a minute earlier.
EARLY = 60


@pytest.fixture(scope="module")
def cluster():
    if reason := slurm_cluster.problem():
        pytest.skip(reason)
    with slurm_cluster.Cluster() as cluster:
        yield cluster


@pytest.fixture
def checkout(here, monkeypatch):
    """A folder with what the page's script uses of a checkout, and the script as `train.sbatch`,
    with one rank a node.
    """
    (here / ".venv/bin").mkdir(parents=True)
    path = f"export PATH={Path(sys.executable).parent}:$PATH PYTHONPATH={ROOT}\n"
    (here / ".venv/bin/activate").write_text(path)
    (here / "train.py").symlink_to(ROOT / "train.py")
    page = (ROOT / "docs/scaling.md").read_text()
    (script,) = re.findall(r"```bash\n(#!/bin/bash\n.*?)```", page, re.DOTALL)
    (here / "train.sbatch").write_text(script.replace("proc-per-node=8", "proc-per-node=1"))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return here


def submit(cluster, *words):
    """Submits a job. Returns its number."""
    return cluster.read("sbatch", "--parsable", *words).strip()


def wait_until(cluster, is_done):
    deadline = time.monotonic() + HUNG
    while not is_done():
        assert time.monotonic() < deadline, cluster.logs()
        time.sleep(0.5)


def finish(cluster, number):
    """Waits until a job has ended. Returns its state and what it printed."""
    wait_until(cluster, lambda: not cluster.read("squeue", "--noheader", f"--jobs={number}"))
    job = cluster.read("scontrol", "show", "job", number)
    return re.search(r"JobState=(\w+)", job).group(1), printed(number)


def limit(cluster, number):
    """Sets the time limit of a job so that it gets its signal within two minutes."""
    job = cluster.read("scontrol", "show", "job", number)
    days, hours, minutes = re.search(r"RunTime=(?:(\d+)-)?(\d+):(\d+)", job).groups()
    minutes = 60 * (24 * int(days or 0) + int(hours)) + int(minutes) + 2
    cluster.read("scontrol", "update", f"job={number}", f"TimeLimit={minutes}")


def printed(number):
    path = Path(f"megastep-{number}.txt")
    return path.read_text() if path.exists() else ""


def rows(folder):
    path = Path(folder, "metrics.jsonl")
    return json_lines.read(path) if path.exists() else []


def whole(folder):
    """Returns the state of both ranks in the last checkpoint, without the seconds."""
    path = Path(folder, "checkpoints", f"step_{2 * N * tiny.UPDATE}")
    return [checkpoint.load_latest(path, rank=rank).state | {"seconds": 0} for rank in range(2)]


def test_script_trains_on_two_nodes_and_a_requeued_job_goes_on(cluster, checkout):
    alone = submit(cluster, "train.sbatch", *WORDS, SAMPLES, "folder=alone")
    state, text = finish(cluster, alone)
    assert state == "COMPLETED" and "Training on 2 x cpu in alone\n" in text, text
    (provenance,) = json_lines.read(Path("alone/provenance.jsonl"))
    assert sorted(provenance["hosts"].split(", ")) == [*slurm_cluster.NODES]

    number = submit(cluster, "--requeue", "train.sbatch", *WORDS, SAMPLES, "resume=auto")
    folder = Path("runs", f"slurm-{number}")
    wait_until(cluster, lambda: checkpoint.list_checkpoints(folder / "checkpoints"))
    cluster.read("scontrol", "requeue", number)
    assert len(rows(folder)) < N, "choose more updates"
    state, text = finish(cluster, number)
    assert state == "COMPLETED", text
    assert len(json_lines.read(folder / "provenance.jsonl")) == 2
    assert (folder / "metrics.jsonl").read_bytes() == Path("alone/metrics.jsonl").read_bytes()
    assert differences(whole(folder), whole("alone")) == []


def test_job_that_outlives_its_time_saves_and_stops(cluster, checkout):
    words = f"--signal=TERM@{EARLY}", "train.sbatch", *WORDS, "seconds=36000", "folder=run"
    number = submit(cluster, *words)
    wait_until(cluster, lambda: checkpoint.list_checkpoints(Path("run/checkpoints")))
    limit(cluster, number)
    state, text = finish(cluster, number)
    assert state in ("FAILED", "TIMEOUT")
    loaded = checkpoint.load_latest(Path("run/checkpoints"))
    stopped = f"train.py: Stopped after {loaded.step:,} samples. To continue: python train.py "
    assert f"{stopped}resume=run\n" in text and loaded.step > 0, text
    words = f"more_samples={2 * tiny.UPDATE}", "resume=run"
    state, text = finish(cluster, submit(cluster, "train.sbatch", *words))
    assert state == "COMPLETED", text
    assert rows("run")[-1]["samples"] == loaded.step + 2 * tiny.UPDATE


def sweep(cluster, *words, meanwhile=lambda: None):
    """Runs a sweep on the login node. Returns the rows of its table."""
    options = "partition=gpu", "gpus_per_node=1", "cpus_per_task=1"
    launcher = [f"hydra.launcher.{option}" for option in options]
    words = (
        "-m",
        *WORDS,
        "hydra.sweep.dir=sweep",
        "hydra/launcher=submitit_slurm",
        *launcher,
        *words,
    )
    process = subprocess.Popen(
        cluster.words(slurm_cluster.LOGIN, sys.executable, ROOT / "train.py", "-m", *words),
        env=cluster.environment(),
    )
    try:
        meanwhile()
        assert process.wait(timeout=HUNG) == 0
    finally:
        process.kill()
        process.wait()
    with open("sweep/sweep.csv") as file:
        return list(csv.DictReader(file))


def test_job_of_a_sweep_that_outlives_its_time_goes_on_in_another(cluster, checkout):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")

    def meanwhile():
        saved = "sweep/0*/checkpoints/step_*"
        wait_until(cluster, lambda: any(p.name[5:].isdecimal() for p in Path().glob(saved)))
        (number,) = cluster.read("squeue", "--noheader", "--format=%A").split()
        limit(cluster, number)
        show = "scontrol", "show", "job", number
        wait_until(cluster, lambda: "Restarts=1" in cluster.read(*show))
        cluster.read("scontrol", "update", f"job={number}", "TimeLimit=60")

    words = f"hydra.launcher.signal_delay_s={EARLY}", "seed=1", "seconds=150"
    (row,) = sweep(cluster, *words, meanwhile=meanwhile)
    assert row["state"] == "done"
    (folder,) = Path("sweep").glob("0*")
    assert len(json_lines.read(folder / "provenance.jsonl")) == 2
