"""`ranks=2` on one machine: one voice, the exit codes of one process, and nothing left behind."""

import contextlib
import os
import re
import signal
import sys
import time
from pathlib import Path

import pytest
import torch

from megastep.agents.cli import train
from megastep.agents.errors import ConfigErrors, UserError
from megastep.agents.launch import gpu, launcher
from megastep.agents.launch.endings import LOST, Ending
from megastep.agents.launch.signals import Interrupted
from megastep.agents.runs import checkpoint, json_lines
from tests.helpers import ranks, tiny
from tests.helpers.hosts import children
from tests.helpers.processes import Forked, forked, is_running, wait_until
from tests.helpers.ranks import HUNG, ROOT

pytestmark = pytest.mark.usefixtures("here")
TINY = [*tiny.TINY, "logging.every=1", "folder=run"]
UPDATE = 2 * tiny.UPDATE
ON_GPUS = [*tiny.ON_GPU, "folder=run"]
UPDATE_ON_GPUS = 2 * tiny.UPDATE_ON_GPU
TWO_GPUS = [
    pytest.mark.cuda,
    pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two GPUs"),
]


# ---- The settings ----


@pytest.mark.parametrize(
    "words, n_gpus, cure",
    [
        (["ranks=3", "device=auto"], 2, "ranks: 3 is more than the 2 GPUs"),
        (["ranks=3", "device=auto"], 1, "ranks: 3 is more than the 1 GPU "),
        (["ranks=all", "device=auto"], 0, "ranks: 'all' uses every GPU, but this machine has none"),
        (["ranks=all", "device=cpu"], 2, "device=cpu; give a number"),
        (["ranks=2", "device=cuda:1"], 2, "device: 'cuda:1' names one GPU"),
        (["ranks=0"], 2, "ranks: 0 is out of range: allowed is at least 1"),
        (["ranks=many"], 2, "ranks: expected an integer, got 'many'; 'all' is allowed too"),
    ],
)
def test_bad_ranks(here, monkeypatch, capsys, words, n_gpus, cure):
    monkeypatch.setattr(gpu, "count", lambda: n_gpus)
    assert train.main([*TINY, *words]) == 2
    assert cure in capsys.readouterr().err and not any(here.iterdir())


@pytest.mark.parametrize(
    "words, n_gpus, expected",
    [
        (["ranks=all", "device=auto"], 4, 4),
        (["ranks=2", "device=auto"], 4, 2),
        (["ranks=3", "device=auto"], 0, 3),
        (["ranks=9", "device=cpu"], 2, 9),
        (["device=cuda:1"], 2, 1),
    ],
)
def test_number_of_ranks(monkeypatch, words, n_gpus, expected):
    monkeypatch.setattr(gpu, "count", lambda: n_gpus)
    cfg = tiny.settings(*TINY, *words)
    assert launcher.n_ranks(cfg) == expected
    assert launcher.is_needed(cfg) == (expected > 1)


def as_rank(monkeypatch, rank, n_ranks):
    for name, value in dict(RANK=rank, WORLD_SIZE=n_ranks, LOCAL_RANK=rank).items():
        monkeypatch.setenv(name, str(value))


def test_ranks_under_torchrun(monkeypatch):
    as_rank(monkeypatch, 0, 2)
    for words in ([], ["ranks=2"]):
        cfg = tiny.settings(*TINY, *words)
        assert cfg.ranks == 2 and not launcher.is_needed(cfg)
    with pytest.raises(ConfigErrors, match="ranks: 3 is not .* torchrun has started, 2;"):
        tiny.settings(*TINY, "ranks=3")


@pytest.mark.parametrize("rank, n_lines", [(0, 1), (1, 0)])
def test_sweep_under_torchrun(here, monkeypatch, capsys, rank, n_lines):
    as_rank(monkeypatch, rank, 2)
    assert train.main([*tiny.TINY, "-m", "seed=1,2"]) == 2
    assert capsys.readouterr().err.count("leave torchrun out") == n_lines
    assert not any(here.iterdir())


def test_dry_run(here, capsys):
    assert train.main([*TINY, "ranks=3", "dry_run=true"]) == 0
    text = capsys.readouterr().out
    assert "3 x cpu" in text and not any(here.iterdir())
    numbers = {"environments": 4, "per update": 4 * 8, "per minibatch": 4 * 8 // 2}
    for name, number in numbers.items():
        (line,) = (line for line in text.splitlines() if name in line)
        assert {str(number), str(3 * number)} <= set(line.split())


def test_dry_run_of_a_job_for_gpus_that_are_elsewhere(here, capsys, monkeypatch):
    monkeypatch.setattr(gpu, "is_available", lambda: False)
    assert train.main([*TINY, "ranks=8", "device=cuda", "dry_run=true"]) == 0
    assert "Would train on 8 x cuda:" in capsys.readouterr().out


def test_dry_run_counts_lanes_that_learn(here, capsys):
    duels = "env=deathmatch", "geometry=box", "device=cpu", "dry_run=true"
    sizes = "env.n_envs=10", "env.n_agents=3", "opponents.past=0.4", "opponents.snapshots=2"
    assert train.main([*duels, *sizes, "opponents.bot=0.2", "learner.n_steps=8"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    (learn,) = (line for line in lines if "learn" in line)
    (update,) = (line for line in lines if "update" in line)
    # six environments have opponents, two each
    assert str(30 - 6 * 2) in learn and str(8 * (30 - 6 * 2)) in update
    assert train.main([*duels, *sizes, "opponents.past=0.9", "opponents.bot=0.2"]) == 2
    assert "their sum must be above 0 and at most 1" in capsys.readouterr().err


# ---- What the ranks' endings mean for the process that launched them ----


#: Two ranks, of which the second writes an ending and ends; the first ends for good as well.
ENDS = """
import json, os, signal, sys, time
from megastep.agents.launch import endings

ending, code = {}
if os.environ["RANK"] == "1":
    if ending:
        path = endings.Path(os.environ[endings.JOB], endings.ENDING)
        endings.write_atomically(path, json.dumps(ending).encode())
    os.kill(os.getpid(), 9) if code < 0 else os._exit(code)
time.sleep(60 * bool(code))
"""


def launched(monkeypatch, ending, code):
    """Trains with ranks that end as given. Returns the run folder."""
    monkeypatch.setattr(launcher, "CODE", ENDS.format((ending and tuple(ending), code)))
    return train.run(tiny.settings(*TINY, "ranks=2"))


def test_launched_run_ends_as_its_ranks_do(monkeypatch):
    assert str(launched(monkeypatch, Ending(folder="run"), 0)) == "run"
    with pytest.raises(UserError, match="too small") as error:
        launched(monkeypatch, Ending(1, "too small"), 0)
    assert error.value.code == 1
    with pytest.raises(Interrupted) as error:
        launched(monkeypatch, Ending(143, "Stopped after 3 samples"), 0)
    assert error.value.args == (143 - 128, "Stopped after 3 samples")
    with pytest.raises(
        UserError, match="rank 1 on .* SIGKILL, perhaps .*Nothing was saved"
    ) as error:
        launched(monkeypatch, None, -9)
    assert error.value.code == LOST


def test_ranks_share_the_cores_that_they_may_use(here, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 128)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: range(16))
    assert launcher.variables(here, 2)["OMP_NUM_THREADS"] == "8"


# ---- Two ranks ----


@contextlib.contextmanager
def started(here, *words, base=TINY, **env):
    """Starts two ranks of the run that the words of `base` and `words` say. A context, at whose end
    none is left.
    """
    (here / "tmp").mkdir(exist_ok=True)
    env = dict(TMPDIR=str(here / "tmp")) | env
    process = forked("train", *base, "ranks=2", *words, **env)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@contextlib.contextmanager
def saving(here, *words, **options):
    """As `started`, for a run that has saved a checkpoint and goes on."""
    with started(here, "checkpoints.seconds=1", *words, **options) as process:
        wait_until(lambda: [*(here / "run" / "checkpoints").glob("step_*[0-9]")], process)
        time.sleep(1)
        yield process


def wait_for_end(process):
    """Returns the exit code, what was printed, and the seconds it took."""
    began = time.monotonic()
    out, err = process.communicate(timeout=HUNG)
    return process.returncode, out, err, time.monotonic() - began


@pytest.mark.parametrize(
    "number, is_group, base, update",
    [
        pytest.param(signal.SIGINT, False, TINY, UPDATE, marks=pytest.mark.nightly),
        pytest.param(signal.SIGTERM, True, TINY, UPDATE, marks=pytest.mark.slow),
        pytest.param(signal.SIGINT, True, ON_GPUS, UPDATE_ON_GPUS, marks=TWO_GPUS),
    ],
    ids=["SIGINT-cpu", "SIGTERM-cpu", "SIGINT-cuda"],
)
def test_signal_saves_once_and_a_resumed_run_has_one_voice(
    here, number, is_group, base, update, capfd
):
    with saving(here, base=base) as run:
        (os.killpg if is_group else os.kill)(run.pid, number)
        code, out, err, _ = wait_for_end(run)
    assert code == 128 + number and out.count("Stopping after this update") == 1
    samples = checkpoint.load_latest(here / "run" / "checkpoints").step
    resume = "To continue: python train.py resume=run"
    assert err == f"train.py: Stopped after {samples:,} samples. {resume}\n"
    assert not any((here / "tmp").iterdir()) and not (here / "run" / "lock").exists()
    total, finish = samples + 2 * update, ["finish.evaluate=true", "finish.episodes=8"]
    assert train.main(["resume=run", f"samples={total}", *finish]) == 0  # with two ranks again
    assert checkpoint.load_latest(here / "run" / "checkpoints").step == total
    out, err = capfd.readouterr()
    assert not err and out.count("samples ·") == out.count("minimal: 8 episodes") == 1
    rows = json_lines.read(here / "run" / "metrics.jsonl")
    assert [row["updates"] for row in rows] == [*range(1, total // update + 1)]


@pytest.mark.parametrize(
    "rank, number, base",
    [
        pytest.param(0, signal.SIGKILL, TINY, marks=pytest.mark.nightly),
        pytest.param(1, signal.SIGKILL, TINY, marks=pytest.mark.slow),
        pytest.param(1, signal.SIGSTOP, TINY, marks=pytest.mark.slow),
        pytest.param(0, signal.SIGKILL, ON_GPUS, marks=TWO_GPUS),
        pytest.param(1, signal.SIGKILL, ON_GPUS, marks=TWO_GPUS),
        pytest.param(1, signal.SIGSTOP, ON_GPUS, marks=TWO_GPUS),
    ],
)
def test_killed_rank(here, rank, number, base):
    with saving(here, base=base) as run:
        pids = children(run.pid)
        os.kill(pids[rank], number)
        code, out, err, seconds = wait_for_end(run)
    assert code == LOST and seconds < 60
    assert err.startswith(f"train.py: rank {rank} on ") and err.count("\n") == 1
    assert "killed" in err and err.endswith("To continue: python train.py resume=run\n")
    assert "Stopping" not in out and not any(map(is_running, pids))
    assert checkpoint.load_latest(here / "run" / "checkpoints").step > 0


def listening(pids):
    """Returns the addresses, in hexadecimal, at which processes listen."""
    inodes = set()
    for pid in pids:
        for handle in Path(f"/proc/{pid}/fd").iterdir():
            try:
                inodes.add(os.readlink(handle))
            except OSError:  # closed meanwhile
                continue
    addresses = set()
    for name in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and f"socket:[{fields[9]}]" in inodes:
                addresses.add(fields[1].rpartition(":")[0])
    return addresses


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_ranks_listen_on_loopback_alone_and_end_with_the_process_that_launched_them(here):
    with saving(here) as run:
        pids = children(run.pid)
        assert listening([run.pid, *pids]) == {"0100007F"}  # 127.0.0.1
        run.kill()
        deadline = time.monotonic() + 30
        while any(map(is_running, pids)) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert not any(map(is_running, pids))
    assert checkpoint.load_latest(here / "run" / "checkpoints").step > 0


#: An environment that needs too much memory on rank 1, once there is a checkpoint.
ODD = """
import os
from pathlib import Path
from megastep.envs import Minimal

class Odd(Minimal):
    def step(self, decision):
        saved = [p for p in Path("run/checkpoints").glob("step_*") if p.name[5:].isdecimal()]
        if saved and os.environ["RANK"] == "1":
            raise MemoryError
        return super().step(decision)
"""


@pytest.mark.slow
def test_rank_that_fails_alone(here):
    (here / "odd.py").write_text(ODD)
    with started(here, "env=odd:Odd", "checkpoints.seconds=0.2", "logging.every=100") as run:
        code, _, err, seconds = wait_for_end(run)
    assert code == 2 and seconds < 60
    assert err.startswith("train.py: rank 1 on ") and err.count("\n") == 1
    assert "Out of memory" in err and "resume=run" in err


DRIFTS = """
import megastep.agents.algorithms.gradient_steps as steps
from megastep.agents.algorithms.ppo import PPO as Drifts

steps.average_gradients = lambda parameters, n, means=(): (n, [mean.detach() for mean in means])
"""


@pytest.mark.slow
def test_learner_that_does_not_average(here):
    (here / "drifts.py").write_text(DRIFTS)
    with started(here, "learner=drifts:Drifts", f"samples={9 * UPDATE}") as run:
        code, _, err, _ = wait_for_end(run)
    assert code == 2 and err.startswith("train.py: The ranks drift apart: policy.")
    assert "differs on rank 1; " in err and "average_gradients" in err and err.count("\n") == 1


@pytest.mark.slow
def test_torchrun(here):
    command = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    command += [ROOT / "train.py", *TINY, f"samples={3 * UPDATE}"]
    process = Forked(command, here, os.environ | {"PYTHONPATH": str(ROOT)})
    out, err = process.communicate(timeout=HUNG)
    assert process.returncode == 0 and out.startswith("Training on 2 x cpu in run\n"), err


DIFFERING = """
import os, sys
from megastep.agents.cli import train
sys.exit(train.main([*sys.argv[1:], "learner.lr=0.00" + str(1 + int(os.environ["RANK"]))]))
"""


@pytest.mark.slow
def test_ranks_with_different_words(here):
    (here / "differing.py").write_text(DIFFERING)
    both = ranks.run([here / "differing.py", *TINY, f"samples={9 * UPDATE}"])
    line = r"The ranks drift apart: policy\.\S+ differs on rank 1; start all with"
    assert all(one.returncode for one in both)
    assert any(re.search(line, one.stderr) for one in both), both
