"""A run's NaN or infinity is reproduced by the command that its warning names."""

import shlex
from pathlib import Path

import pytest
import torch

from megastep import spaces
from megastep.agents.cli import train
from megastep.agents.runs import checkpoint
from megastep.arrdict import arrdict

pytestmark = pytest.mark.usefixtures("here")
T, N, A = 8, 4, 2
UPDATE = T * N * A
FAULT = 4 * T + 3  # a step of the fifth update


class Walks:
    """Agents walk along a line by their action and by chance. At step `FAULT` those that are far
    from the start earn a huge number made of their place.

    Args:
        wage: reward of a step ahead.
    """

    obs_space, action_space = spaces.MultiVector(1, 1), spaces.MultiDiscrete(1, 3)
    n_agents = A

    def __init__(self, n_envs, device="cpu", seed=1, wage=0.0):
        self.n_envs, self.device = n_envs, torch.device(device)
        self.generator = torch.Generator(device).manual_seed(seed)
        self.wage, self.earned = wage, 0.0
        self.clock = torch.zeros((), dtype=torch.int64, device=device)
        self.places = torch.zeros(n_envs * A, device=device)

    def reset(self):
        self.clock.zero_()
        self.places.zero_()
        return self._world(is_first=True)

    def step(self, decision):
        self.clock.add_(1)
        noise = torch.rand(len(self.places), generator=self.generator, device=self.device)
        self.places.add_(decision["actions"][:, 0] - 1 + noise)
        self.earned = self.wage * (decision["actions"][:, 0] == 2)
        return self._world(is_first=False)

    def _world(self, is_first):
        reset = torch.full_like(self.places, is_first, dtype=torch.bool)
        is_bad = (self.clock == FAULT) & (self.places > 15)
        reward = torch.where(is_bad, 1e13 * self.places, self.earned)
        obs, never = self.places[:, None, None] / 100, torch.zeros_like(reset)
        return arrdict(obs=obs, reward=reward, reset=reset, terminal=never, truncated=never)


DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
TINY = [f"env={__name__}:Walks", f"env.n_envs={N}", "logging.every=4", f"learner.n_steps={T}"]
TINY += ["agent.width=8", f"samples={12 * UPDATE}", "folder=run"]
PPO = ["learner.n_minibatches=2"]
R2D2 = ["learner=r2d2", "learner.gradient_steps=2", "learner.replay.burn_in=4"]
R2D2 += ["learner.replay.capacity=2000"]
OPPONENTS = [*PPO, "opponents.past=0.5", "opponents.snapshots=1", "opponents.every=2"]
EVERY_UPDATE = "checkpoints.seconds=1e-9"


def met(capsys, *words):
    """Trains. Returns the number and what is said after it, in the warning and at the end."""
    assert train.main([*words]) == 1
    *_, warning, sentence = capsys.readouterr().err.splitlines()
    number, hint = warning.removeprefix("warning: ").split("; its rollout was skipped")
    assert number.startswith("reward of lane") and f" at step {FAULT}" in number
    assert sentence.startswith(f"train.py: {number}. All other rollouts") and sentence.endswith(
        hint
    )
    return number, hint


def files_of_run():
    """Returns the content of the run's files, without the checkpoint that is kept."""
    paths = [path for path in Path("run").rglob("*") if path.is_file()]
    return {path: path.read_bytes() for path in paths if path.parts[1] != "nonfinite"}


def updates_in(folder):
    """Returns the updates before each of a run's checkpoints."""
    paths = checkpoint.list_checkpoints(f"{folder}/checkpoints")
    return [checkpoint.load_latest(path, None).numbers["updates"] for path in paths]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    "more",
    [OPPONENTS, [*PPO, "learner=vtrace"], R2D2],
    ids=["opponents", "vtrace", "r2d2"],
)
def test_a_resumed_run_meets_it_again(more, device, capsys):
    """Later checkpoints have replaced the one before it by then; the run stays as it is."""
    number, hint = met(capsys, *TINY, *more, EVERY_UPDATE, f"device={device}")
    before = files_of_run()
    assert updates_in("run/nonfinite") == [4] and min(updates_in("run")) > 5
    assert hint == ". To reproduce it: python train.py resume=run/nonfinite"
    again, _ = met(capsys, *shlex.split(hint)[-1:])
    assert again == number and files_of_run() == before


@pytest.mark.parametrize("device", DEVICES)
def test_a_repeated_run_meets_it_again_where_nothing_was_saved_before(device, capsys):
    number, hint = met(capsys, *TINY, *PPO, f"device={device}")
    assert hint == ". To reproduce it, once this run has ended: python train.py rerun=run"
    again, _ = met(capsys, "rerun=run", "folder=again")
    assert again == number and not Path("run/nonfinite").exists()


def test_learning_rates_of_a_clock_are_kept(capsys):
    words = [*TINY, *PPO, EVERY_UPDATE, "learner.anneal=seconds", "seconds=60", "learner.lr=0.1"]
    number, hint = met(capsys, *words)
    again, _ = met(capsys, *shlex.split(hint)[-1:])
    assert again == number


def test_a_budget_that_was_extended_is_part_of_the_command(capsys):
    words = [*TINY, *PPO, f"samples={2 * UPDATE}"]
    assert train.main(words) == 0
    number, hint = met(capsys, "resume=run", f"samples={12 * UPDATE}")
    assert hint.endswith(f" resume=run/nonfinite samples={12 * UPDATE}")
    again, _ = met(capsys, *shlex.split(hint)[-2:])
    assert again == number


def test_a_checkpoint_that_cannot_be_kept_ends_no_run(capsys, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("shutil.copytree", full)
    _, hint = met(capsys, *TINY, *PPO, EVERY_UPDATE)
    assert hint.startswith(". The checkpoint before it could not be kept ([Errno 28] No space")
    assert not Path("run/nonfinite").exists()


def test_a_policy_that_diverges_is_not_repeated_without_a_checkpoint(capsys):
    words = ["env.wage=1", "learner.lr=1e3", "learner.max_grad_norm=1e6", "learner.entropy_coef=0"]
    assert train.main([*TINY, *PPO, *words, f"samples={60 * UPDATE}"]) == 1
    assert "rerun" not in capsys.readouterr().err
