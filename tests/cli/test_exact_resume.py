"""A run that is interrupted and resumed has the bits of one that is left alone."""

import os
import signal
import time

import numpy as np
import pytest
import torch

from megastep import spaces
from megastep.agents.cli import entry, train
from megastep.agents.runs import checkpoint
from megastep.agents.storage.collector import Collector
from megastep.agents.training import budget
from megastep.arrdict import arrdict
from tests.helpers import tiny
from tests.helpers.processes import HUNG, forked

pytestmark = pytest.mark.usefixtures("here")
SELF_PLAY = ["opponents.past=0.5", "opponents.snapshots=2", "opponents.every=3"]
REPLAY = ["learner.replay.capacity=200"]
SMALL = ["geometry=box", "env.n_envs=4", "agent.width=8", "learner.n_steps=8", "device=cpu"]
FIGHT = [*("env=deathmatch", "env.n_agents=2", "env.res=8", *SMALL), "learner.n_minibatches=2"]
DRAWN = [*SMALL[1:], "geometry=bench", "geometry.n=4", "env.res=8", "learner.n_minibatches=2"]
PONG = ["env=pong", "env.n_envs=8", "agent.width=8", "learner.n_steps=8", "device=cpu"]
EVERY_UPDATE = ["checkpoints.seconds=1e-9", "checkpoints.keep=99"]
slow = pytest.mark.slow
CASES = {
    "ppo": [*tiny.TINY, *tiny.SHORT_EPISODES],
    "vtrace": [*tiny.TINY, "learner=vtrace"],
    "priorities": [
        *(*tiny.TINY, "learner=vtrace", "learner.buffer=replay", *REPLAY),
        "learner.replay.alpha=0.6",
    ],
    "r2d2": [
        *("env=minimal", "env.res=8", *SMALL, "learner=r2d2", "learner.gradient_steps=2"),
        *("learner.replay.burn_in=4", "learner.target_period=3", *REPLAY),
    ],
    "gru": [*tiny.TINY, "agent.core=gru"],
    "mingru": [*tiny.TINY, "agent.core=mingru"],
    "explorer": ["env=explorer", "env.res=8", *SMALL, "learner.n_minibatches=2"],
    "memory": ["env=memory", "env.res=8", "env.limit=9", *SMALL],
    "pointgoal": ["env=pointgoal", "env.res=8", *SMALL, "learner.n_minibatches=2"],
    "deathmatch": FIGHT,
    "sfl": [*DRAWN, "env=explorer", "env.patience=3", "curriculum=sfl", "curriculum.every=3"],
    "rounds": [
        *(*FIGHT, "geometry=bench", "geometry.n=4", "env.resample=true", "env.limit=12"),
        *(*SELF_PLAY, "curriculum=sfl"),
    ],
    "opponents": [*FIGHT, *SELF_PLAY, "opponents.bot=0.25"],
    "pong": [*PONG, "learner.n_minibatches=2"],
    "continuous": [
        *("env=tests.cli.test_exact_resume:Steered", *tiny.TINY[2:], "learner=vtrace"),
        *("learner.buffer=replay", *REPLAY),
    ],
    "beta": [
        *("env=tests.cli.test_exact_resume:Steered", *tiny.TINY[2:], "agent.continuous=beta"),
    ],
    "gymnasium": [
        *("env=gymnasium", "env.id=CartPole-v1", *SMALL[1:], "learner.n_minibatches=2"),
    ],
    "hooks": [
        *tiny.TINY,
        *("learner=tests.helpers.headed:Headed", "learner.optimizer=torch.optim:RMSprop"),
        *("learner.entropy_coef={from:0.02,to:0.001}", "learner.warmup=9"),
        *(
            "learner.lambda_=tests.helpers.headed:falling",
            "env=pointgoal",
            "env.cost={from:0,to:1}",
        ),
    ],
    "wrappers": [
        *("env=explorer", "env.res=8", *SMALL, "learner.n_minibatches=2"),
        "env.wrappers=[sticky_actions,{name:frame_stack,n:3},{name:time_limit,n:7},"
        "{name:noisy_sensor,sensor:imu}]",
    ],
    "stranger": ["env=tests.cli.test_exact_resume:Drifting", *tiny.TINY[2:]],
}
FAST = (
    "explorer",
    "priorities",
    "r2d2",
    "opponents",
    "stranger",
    "beta",
    "hooks",
    "wrappers",
)
#: What shares its state with a case of the other tiers.
NIGHTLY = ("gru", "none", "memory", "pointgoal", "sfl", "pong")


def tiers(case):
    return [pytest.mark.nightly] if case in NIGHTLY else [slow] * (case not in FAST)


class Drifting:
    """An environment by somebody who keeps state in all the ways there are."""

    def __init__(self, n_envs, res=8, seed=1, device="cpu"):
        self.n_envs, self.device = n_envs, torch.device(device)
        self.obs_space, self.action_space = spaces.MultiVector(1, 3), spaces.MultiDiscrete(1, 2)
        self.places = torch.zeros(n_envs)
        self.wind, self.random = np.zeros(n_envs), np.random.default_rng(seed)
        self.n_steps, self.history, self.best = 0, [], {}
        self.last = None

    def world(self, ended):
        drift = torch.as_tensor(self.wind, dtype=torch.float32)
        obs = torch.stack([self.places, drift, torch.full_like(drift, len(self.history))], 1)
        return arrdict(
            obs=obs[:, None],
            reward=torch.where(ended, 0.0, self.places),
            reset=ended,
            terminal=torch.full((self.n_envs,), self.ends()),
            truncated=torch.zeros(self.n_envs, dtype=torch.bool),
        )

    def ends(self):
        return self.n_steps % 5 == 0 and self.n_steps > 0

    def reset(self):
        return self.world(torch.ones(self.n_envs, dtype=torch.bool))

    def step(self, decision):
        ended = torch.full((self.n_envs,), self.ends())
        self.n_steps += 1
        self.wind += self.random.normal(size=self.n_envs) + np.random.random() * 0.1
        self.places = self.places * 0.9 + torch.rand(self.n_envs)  # of the global generator
        self.last = self.places if self.last is None else self.last + self.places
        self.history = [*self.history[-3:], self.n_steps]
        self.best["place"] = float(self.last.max())
        self.places = self.places + 1e-3 * self.best["place"]
        return self.world(ended)


class Steered:
    """An environment on any device that takes two numbers."""

    def __init__(self, n_envs, res=8, device="cpu"):
        self.n_envs, self.device = n_envs, torch.device(device)
        self.obs_space = spaces.MultiVector(1, 2)
        self.action_space = spaces.MultiContinuous(1, 2, low=(-2.0, 0.0), high=1.0)
        self.places = torch.zeros(n_envs, 1, 2, device=device)
        self.age = torch.zeros(n_envs, dtype=torch.int64, device=device)

    def world(self, ended):
        return arrdict(
            obs=self.places.clone(),
            reward=-self.places.square().sum((1, 2)).masked_fill(ended, 0.0),
            reset=ended,
            terminal=self.age == 7,
            truncated=torch.zeros_like(ended),
        )

    def reset(self):
        self.places.zero_()
        self.age.zero_()
        return self.world(torch.ones(self.n_envs, dtype=torch.bool, device=self.device))

    def step(self, decision):
        ended = self.age == 7
        self.places.add_(decision["actions"]).masked_fill_(ended[:, None, None], 0.0)
        self.age.add_(1).masked_fill_(ended, 0)
        return self.world(ended)


def differences(one, other, path=""):
    """Returns the paths at which two states differ."""
    if isinstance(one, dict):
        assert one.keys() == other.keys(), path
        return [d for key in one for d in differences(one[key], other[key], f"{path}.{key}")]
    if isinstance(one, (list, tuple)):
        assert len(one) == len(other), path
        return [
            d for i, pair in enumerate(zip(one, other)) for d in differences(*pair, f"{path}.{i}")
        ]
    if isinstance(one, torch.Tensor) and one.is_floating_point():  # integers may be stored there
        bits = {2: torch.int16, 4: torch.int32, 8: torch.int64}[one.element_size()]
        one, other = one.view(bits), other.view(bits)
    is_equal = torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other
    return [] if is_equal or path == ".seconds" else [path]


def run(*words):
    assert train.main([*words]) == 0


@pytest.mark.parametrize(
    "case, device",
    [
        *(pytest.param(name, "cpu", marks=tiers(name)) for name in CASES),
        *(
            pytest.param(name, "cuda", marks=pytest.mark.cuda)
            for name in CASES
            if name != "stranger"
        ),
    ],
)
def test_resumed_run_has_the_same_bits(here, case, device):
    """Killed after one of its checkpoints, and when it is resumed after a later one. On a GPU the
    first updates of a process are eager, the others replay graphs.
    """
    if case == "gymnasium":
        pytest.importorskip("gymnasium")
    samples = 512 if "env.n_envs=8" in CASES[case] else 256  # eight updates
    words = [*CASES[case], f"device={device}", f"samples={samples}", "logging.every=2"]
    run(*words, "folder=run", *EVERY_UPDATE)
    alone = checkpoint.load_latest("run/checkpoints").state
    metrics = (here / "run/metrics.jsonl").read_bytes()
    paths = checkpoint.list_checkpoints("run/checkpoints")
    for killed_after in (paths[len(paths) // 3], paths[2 * len(paths) // 3]):
        run(f"resume={killed_after}")
        assert (here / "run/metrics.jsonl").read_bytes() == metrics
        assert differences(checkpoint.load_latest("run/checkpoints").state, alone) == []
    assert len(paths) >= 4 and len(metrics.splitlines()) >= len(paths) // 2


def interrupt_collecting(monkeypatch, call, number):
    """Returns a list that gets the time of the signal."""
    calls, times, collect = [], [], Collector.__call__

    def signalled(self):
        calls.append(1)
        if len(calls) == call:
            times.append(time.monotonic())
            os.kill(os.getpid(), number)
        return collect(self)

    monkeypatch.setattr(Collector, "__call__", signalled)
    return times


def test_interrupted_run_has_the_same_bits(here, monkeypatch):
    """SIGTERM, then Ctrl-C, in rollouts between reports: the reports of the stops are not in the
    file in the end.
    """
    words = [*tiny.TINY, *tiny.SHORT_EPISODES, "samples=320", "logging.every=4"]
    run(*words, "folder=left-alone")
    commands = ([*words, "folder=run"], ["resume=run"])
    for command, number in zip(commands, (signal.SIGTERM, signal.SIGINT)):
        times = interrupt_collecting(monkeypatch, 3, number)
        assert train.main(command) == 128 + number
        assert time.monotonic() - times[0] < 5, "it stops soon"
        monkeypatch.undo()
        monkeypatch.chdir(here)
    stopped = (here / "run/metrics.jsonl").read_bytes()
    run("resume=run")
    expected = (here / "left-alone/metrics.jsonl").read_bytes()
    assert (here / "run/metrics.jsonl").read_bytes() == expected
    assert stopped not in expected
    states = [checkpoint.load_latest(f"{name}/checkpoints").state for name in ("run", "left-alone")]
    assert differences(*states) == []


@pytest.mark.cuda
def test_processes_side_by_side_have_the_same_bits(here):
    """Those of a run alone. On a GPU they take turns, so each of its kernels may stop and go on
    anywhere; a fault that shows in one of many runs may still pass.
    """
    words = ["env=explorer", "geometry=bench", "samples=20_000_000", "device=cuda"]
    words += ["finish.evaluate=false", "finish.record=false"]
    processes = []

    def begin(name):
        process = forked("train", *words, f"folder={name}", cwd=here)
        processes.append(process)

    def wait():
        for process in processes:
            _, err = process.communicate(timeout=HUNG)
            assert process.returncode == 0, err
        processes.clear()

    names = [f"run{i}" for i in range(8)]
    try:
        begin("alone")
        wait()
        for name in names:
            begin(name)
        wait()
    finally:
        for process in processes:
            process.kill()
    alone = checkpoint.load_latest("alone/checkpoints").state
    for name in names:
        assert differences(checkpoint.load_latest(f"{name}/checkpoints").state, alone) == []
        assert (here / name / "metrics.jsonl").read_bytes() == (
            here / "alone/metrics.jsonl"
        ).read_bytes()


def test_inspect(here, capsys):
    run(*tiny.TINY, "samples=64", "folder=run", "logging.every=1")
    capsys.readouterr()
    assert entry.run_command("inspect", ["rum"]) == 2
    assert "did you mean run?" in capsys.readouterr().err
    assert entry.run_command("inspect", ["latest"]) == 0
    out = capsys.readouterr().out
    assert "step_64: intact, format 8" in out and "updates 2" in out
    assert all(word in out for word in ("world.pt", "policy: ", "torch"))
    with open(here / "run/checkpoints/step_64/world.pt", "r+b") as file:
        file.seek(1000)
        file.write(b"?")
    assert entry.run_command("inspect", ["run"]) == 1
    assert "world.pt does not match the SHA-256" in capsys.readouterr().out


def test_rerun(here, capsys):
    """A run whose learning rate followed the clock is repeated, though it was interrupted."""
    words = ["seconds=0.8", "checkpoints.seconds=0.05", "checkpoints.keep=99"]
    run(*tiny.TINY, *words, "logging.every=2", "folder=run")
    *reports, _ = (here / "run/metrics.jsonl").read_bytes().splitlines()
    factors = budget.read_record("run")
    killed_after = checkpoint.list_checkpoints("run/checkpoints")[0]
    run(f"resume={killed_after}")
    assert (here / "run/metrics.jsonl").read_bytes().splitlines()[: len(reports)] == reports
    assert budget.read_record("run")[: len(factors)] == factors
    capsys.readouterr()
    run("rerun=run", "folder=again")
    assert "metrics.jsonl equals that of run, byte for byte" in capsys.readouterr().out
    assert (here / "again/annealing.f64").read_bytes() == (here / "run/annealing.f64").read_bytes()
    lines = (here / "run/metrics.jsonl").read_text().splitlines(keepends=True)
    (here / "run/metrics.jsonl").write_text("".join([lines[0], lines[-1]]))
    assert train.main(["rerun=run", "folder=third"]) == 1
    assert "from line 2 on" in capsys.readouterr().err
    (here / "run/annealing.f64").unlink()
    assert train.main(["rerun=run", "folder=fourth"]) == 2
    assert "it has no annealing.f64" in capsys.readouterr().err
    assert not (here / "fourth").exists()
