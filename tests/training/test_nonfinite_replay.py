"""Files that replay a non-finite number: the same steps from the same state show it again."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from megastep import spaces
from megastep.agents.algorithms.nonfinite import NonFiniteCheck, NonFiniteValue
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.algorithms.vtrace import VTrace
from megastep.agents.networks.policy import Policy
from megastep.agents.runs.saver import Saver
from megastep.agents.selfplay.opponents import Opponents
from megastep.agents.training.budget import Budget
from megastep.agents.training.nonfinite_recorder import (
    MAX_SHARED_BYTES,
    RolloutRecorder,
    make_recorder,
)
from megastep.agents.training.nonfinite_replay import Recording, ReplayError
from megastep.agents.training.trainer import Trainer
from megastep.arrdict import arrdict
from tests.helpers.synchronisation import no_synchronisation

N, A, T = 6, 2, 4


class Walks:
    """Agents walk on a line by their action and by chance. Beyond `edge` the reward is the place
    times 1e13. State has the environments first, second or not at all.
    """

    obs_space, action_space = spaces.MultiVector(1, 1), spaces.MultiDiscrete(1, 3)
    n_envs, n_agents, device = N, A, torch.device("cpu")

    def __init__(self, edge=6.0):
        self.edge, self.generator = edge, torch.Generator().manual_seed(1)
        self.places = torch.zeros(2, N * A)  # in the row, where they are
        self.scales = torch.ones(N, dtype=torch.bfloat16)
        self.wind, self.marks = torch.zeros(()), torch.zeros(N, 1)
        self.map = torch.ones(MAX_SHARED_BYTES // 4 + 1)

    def reset(self):
        self.places, self.wind, self.moved = torch.zeros_like(self.places), torch.zeros(()), None
        return self._world(torch.ones(N * A, dtype=torch.bool))

    def step(self, decision):
        self.wind = self.wind + 0.01
        noise = torch.rand(N * A, generator=self.generator)
        scales = self.scales.repeat_interleave(A).float()
        moved = scales * (decision["actions"][:, 0] - 1) + self.wind * noise
        last = 0 if self.moved is None else self.moved  # a tensor from the first step on
        self.places = torch.stack([self.places[0], self.places[1] + moved * self.map[-1] + last])
        self.moved = moved / 10
        self.scales = (self.scales * 1.01).to(torch.bfloat16)
        return self._world(torch.zeros(N * A, dtype=torch.bool))

    def _world(self, reset):
        none, place = torch.zeros(N * A, dtype=torch.bool), self.places[1]
        reward = torch.where(place.abs() > self.edge, 1e13 * place, 0.0)
        obs = place[:, None, None] / 100
        return arrdict(obs=obs, reward=reward, reset=reset, terminal=none, truncated=none)


def trainer_in(folder, env=None, learner=PPO, past=0.0, **options):
    env = env or Walks()
    policy = Policy(env.obs_space, env.action_space, width=8)
    opponents = Opponents(env, policy, past=past, snapshots=1) if past else None
    learner = learner(policy, n_steps=T, n_minibatches=2, **options)
    logger = type("Silent", (), {name: lambda *_: None for name in ("write", "sync")})()
    return Trainer(
        opponents or env,
        policy,
        learner,
        logger,
        Saver(folder, {}),
        Budget(),
        log_every=7,
        replay_folder=folder,
    )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A trainer that trained until a number was reported, and the only file."""
    folder = tmp_path_factory.mktemp("run")
    run = trainer_in(folder)
    with pytest.warns(UserWarning, match="To see it again: python -m megastep replay"):
        run.train(lambda: run.nonfinite_guard.value is not None)
    (path,) = folder.glob("nonfinite-*.npz")
    assert path.name == f"nonfinite-{run.samples}.npz"
    assert str(path) in run.nonfinite_guard.replay_hint
    return run, path


def test_replay_shows_the_same_number_in_the_same_lanes(recorded):
    """Later rollouts, bad as well, are collected before the report: the first one is kept."""
    run, path = recorded
    value, recorder = run.nonfinite_guard.value, run.nonfinite_guard.recorder
    assert run.updates > value.rollout and recorder is None, "recorded until the first"
    again = Recording(path).replay(Walks())
    assert (again.name, again.lane, again.step) == (value.name, value.lane, value.step)
    assert again.size == value.size, "the same bits"
    assert again.others == value.others


def test_file_holds_the_bad_environments_only(recorded):
    run, path = recorded
    value = run.nonfinite_guard.value
    n_bad = len({one.env for one in (value, *value.others)})
    with np.load(path) as file:
        shapes = {name: file[name].shape for name in file}
    assert shapes["actions"] == (T, n_bad * A, 1)
    assert shapes["state.places"] == (2, n_bad * A) and shapes["state.scales"] == (n_bad,)
    assert shapes["state.wind"] == () and "state.generator" in shapes
    assert "state.map" not in shapes, "large and shared by all environments"


def test_replay_in_another_environment_shows_nothing(recorded):
    _, path = recorded
    assert Recording(path).replay(Walks(edge=1e9)) is None


@pytest.mark.parametrize(
    "change, sentence",
    [
        (lambda env: setattr(env, "n_envs", N + 1), "env.n_envs=6, and this environment has 7"),
        (lambda env: setattr(env, "generator", None), "generator"),
        (lambda env: setattr(env, "marks", torch.zeros(N, 2)), "marks is .* no rows of"),
        (lambda env: setattr(env, "action_space", spaces.MultiDiscrete(2, 3)), "actions"),
    ],
)
def test_what_does_not_fit_is_named(recorded, change, sentence):
    _, path = recorded
    env = Walks()
    world = env.reset()
    env.reset = lambda: world
    change(env)
    with pytest.raises(ReplayError, match=sentence):
        Recording(path).replay(env)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no zip", b"text"])
def test_file_of_something_else_is_refused(tmp_path, content):
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(ReplayError, match="no file of a non-finite number"):
        Recording(tmp_path / "a.npz")


def test_truncated_file_and_other_format_are_refused(tmp_path, recorded):
    path, whole = tmp_path / "a.npz", recorded[1].read_bytes()
    for n in (len(whole) // 2, len(whole) - 5):
        path.write_bytes(whole[:n])
        with pytest.raises(ReplayError):
            Recording(path)
    np.savez(path, header=200_000 * "[")
    with pytest.raises(ReplayError, match="or damaged"):
        Recording(path)
    np.savez(path, header='{"format": 99}')
    with pytest.raises(ReplayError, match="has format 99"):
        Recording(path)


def test_full_disk_ends_no_run(tmp_path, monkeypatch):
    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(RolloutRecorder, "write", full)
    run = trainer_in(tmp_path)
    with pytest.warns(UserWarning, match=r"npz could not be written \(No space left"):
        run.train(lambda: run.nonfinite_guard.value is not None)
    assert run.nonfinite_guard.recorder is None and run.is_saved


def test_numbers_of_the_policy_leave_no_file(tmp_path):
    run = trainer_in(tmp_path, Walks(edge=1e9))
    collect = run.collect

    def bad():
        rollout = collect()
        rollout.values[0, 3] = torch.nan
        return rollout

    run.collect = bad
    with pytest.warns(UserWarning, match="value of lane 3 .* was skipped$"):
        run.train(lambda: run.nonfinite_guard.value is not None)
    assert not list(tmp_path.glob("*.npz"))


def test_where_steps_cannot_be_repeated_nothing_is_recorded(tmp_path):
    lagging = trainer_in(tmp_path, learner=VTrace, lag=1)
    with pytest.warns(UserWarning, match="Nothing was recorded to see it again: .* learner.lag"):
        lagging.train(lambda: lagging.nonfinite_guard.value is not None)
    assert not list(tmp_path.glob("*.npz"))
    learner = PPO(lagging.policy, n_minibatches=2)
    assert make_recorder(Walks(), None, None, learner.collector(Walks())) is None


def test_replay_needs_no_opponents(tmp_path):
    """Opponents' actions are recorded; their lanes, which may be bad before, are not checked."""
    run = trainer_in(tmp_path, past=1.0)
    is_bad_early = ~run.env.learners
    assert run.nonfinite_guard.recorder.played["actions"].shape == (T, N * A, 1)
    with pytest.warns(UserWarning, match="To see it again"):
        run.train(lambda: run.nonfinite_guard.value is not None)
    value, (path,) = run.nonfinite_guard.value, tmp_path.glob("*.npz")
    again = Recording(path).replay(Walks())
    assert (again, again.env) == (dataclasses.replace(value, n_lanes=again.n_lanes), value.env)
    assert not is_bad_early[value.lane] and run.nonfinite_guard.recorder is None


def test_rollouts_before_a_resume_are_not_those_recorded(tmp_path):
    run = trainer_in(tmp_path)
    run.learner.check.record[0] = 5
    recorder = run.nonfinite_guard.recorder
    assert not recorder.has(NonFiniteValue("reward", 0, 20, 1e13, rollout=5))
    recorder.start()
    assert [n for n in (5, 6) if recorder.has(NonFiniteValue("reward", 0, 24, 1e13, n))] == [6]


@pytest.mark.cuda
def test_recording_never_synchronises():
    env, check = Walks(), NonFiniteCheck(torch.device("cuda"))
    tensors = ("places", "scales", "wind", "marks")
    for name in tensors:
        setattr(env, name, getattr(env, name).cuda())
    env.generator = torch.Generator("cuda")
    actions = torch.zeros(T, N * A, 1, dtype=torch.int64, device="cuda")
    recorder, rollout = RolloutRecorder(env, check), SimpleNamespace(actions=actions)
    for _ in range(2):  # builds the kernels
        recorder.start()
        recorder.end(rollout)
    with no_synchronisation():
        env.places.add_(1)
        recorder.start()
        recorder.end(rollout)
        check.record[2:3].fill_(2)  # a number was found
        env.places.add_(1)
        recorder.start()
    assert bool((recorder.state[".places"] == 1).all()) and len(recorder.on_host) == 4
