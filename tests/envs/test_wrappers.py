"""What wrappers of Gymnasium's environments learn belongs to the policy. Global generators."""

import json

import numpy as np
import pytest
import torch

from megastep import contract
from megastep.agents.cli import evaluate, train
from megastep.agents.runs import agent_file, checkpoint, restore

gymnasium = pytest.importorskip("gymnasium")
from megastep.envs import Gymnasium  # noqa: E402
from megastep.hosting.vectorized import VectorizedEnv  # noqa: E402
from tests.helpers.agents import env_of  # noqa: E402

HELPERS = "tests.helpers.learning_wrappers"
NORMALIZE = "gymnasium.wrappers:NormalizeObservation"


def make(*wrappers, id="tests.helpers.odd_envs:OddScores-v0", n_envs=2, **settings):
    wrappers = tuple(name if ":" in name else f"{HELPERS}:{name}" for name in wrappers)
    return Gymnasium(n_envs, id=id, wrappers=wrappers, **{"device": "cpu", **settings})


def played(env, n_steps=25):
    worlds = contract.rollout(env, n_steps)
    env.close()
    return worlds


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_what_a_wrapper_keeps_beyond_an_episode_is_carried_and_frozen(vectorization):
    """Running statistics, but not its count of steps."""
    env = make("Level")
    contract.rollout(env, 35)  # 11 steps each
    state = env.wrapper_state()
    prefix = "0.Level.memory."
    assert state[f"{prefix}count"] == 3 and state[f"{prefix}var"].tolist() == [3, 3]
    assert set(state) == {f"{prefix}{name}" for name in ("mean", "var", "count")}
    other = make("Level", vectorization=vectorization)
    other.load_wrapper_state(state, is_frozen=True)
    worlds = contract.rollout(other, 35)
    assert [world.obs[1].item() for world in worlds[:4]] == [3, 4, 5, 6]
    assert str(other.wrapper_state()) == str(state)
    other.load_wrapper_state(state, is_frozen=False)
    contract.rollout(other, 35)
    assert other.wrapper_state()[f"{prefix}count"] == 6
    other.close()


def test_environment_in_other_wrappers_is_refused():
    state = {"0.NormalizeObservation.obs_rms.mean": torch.zeros(1)}
    with pytest.raises(ValueError, match="needs what its wrapper NormalizeObservation has learnt"):
        make("Level").load_wrapper_state(state, is_frozen=True)


def test_wrappers_that_only_know_the_episode_have_learnt_nothing():
    env = make(id="CartPole-v1")  # with a time limit
    assert env.wrapper_state() == {} and not env.vector.found.generators


def test_returns_before_wrappers_change_rewards_are_a_metric():
    for names, expected in ((["Small"], 10.0), (["gymnasium.wrappers:NormalizeReward"], 10.0)):
        ends = played(make(*names), 10)[-1]
        assert ends.truncated.all() and ends.metrics.true_return.tolist() == 2 * [expected]
    assert "true_return" not in played(make("Level"), 1)[-1].metrics


# ---- In runs ----

SMALL = [
    *("env=gymnasium", "env.n_envs=4", "learner.n_steps=16", "learner.n_minibatches=2"),
    *("agent.width=8", "device=cpu"),
]
PENDULUM = [
    *(*SMALL, "env.id=Pendulum-v1", "env.kwargs.max_episode_steps=20"),
    f"env.wrappers=[{NORMALIZE},gymnasium.wrappers:NormalizeReward]",
]


@pytest.fixture
def loads(monkeypatch):
    """The states that wrappers of environments were given, and whether they were frozen."""
    loads, load = [], VectorizedEnv.load_wrapper_state

    def spied(env, state, is_frozen):
        loads.append((state, is_frozen))
        load(env, state, is_frozen)

    monkeypatch.setattr(VectorizedEnv, "load_wrapper_state", spied)
    return loads


def test_runs_carry_what_wrappers_have_learnt(here, loads):
    """To an evaluation, to another run, to one that resumes without its environments, to a snapshot
    and in the file of an agent.
    """
    words = [*PENDULUM, "env.n_envs=2", "env.vectorization=async"]  # a process each
    words += ["samples=128", "folder=run", "checkpoints.snapshots=1"]
    assert train.main(words) == 0
    saved = checkpoint.load_latest("run/checkpoints")
    learnt = saved.state["wrappers"]
    count = learnt["1.NormalizeObservation.obs_rms.count"]
    assert count == pytest.approx(64 + 1, abs=5) and not loads
    assert is_same(checkpoint.load_latest("run/snapshots").state["wrappers"], learnt)
    assert evaluate.main(["run=run", "episodes=3"]) == 0
    assert train.main(["init=run", *PENDULUM, "samples=128", "folder=next"]) == 0
    assert train.main(["resume=run", "more_samples=64"]) == 0
    states, frozen = zip(*loads, strict=True)
    assert frozen == (True, True, False, False)
    assert all(s["1.NormalizeObservation.obs_rms.count"] == count for s in states)
    for run in ("run", "next"):
        later = checkpoint.load_latest(f"{run}/checkpoints").state["wrappers"]
        assert later["1.NormalizeObservation.obs_rms.count"] > count + 25
    (table,) = (here / "run" / "evaluations").glob("*.json")
    trained, random = json.loads(table.read_text())["rows"]
    for row in (trained, random):  # in Pendulum each step costs at most 16.3
        assert -16.3 * 20 < row["metrics"]["true_return"]["mean"] < 0
    path = here / "agent.safetensors"
    weights = {name: leaf.float() for name, leaf in saved.state["policy"].items()}
    agent_file.write(path, weights, saved.config, {"samples": 256}, wrappers=learnt)
    env = env_of("run", n_envs=1, vectorization="sync")
    assert env.wrapper_state()["1.NormalizeObservation.obs_rms.count"] > count + 25
    restore.load_wrappers(env, agent_file.read(path, "cpu"))
    assert is_same(env.wrapper_state(), learnt)


def is_same(one, other):
    return one.keys() == other.keys() and all(np.array_equal(one[k], other[k]) for k in one)


# ---- Global generators ----


def test_environments_draw_the_same_from_global_generators_in_any_process():
    """Each has its own, whichever others there are; those of this process stay as they are."""

    def numbers(seed=1, **settings):
        worlds = played(make(id=f"{HELPERS}:Draws-v0", n_envs=5, seed=seed, **settings), 12)
        return torch.stack([world.obs.flatten() for world in worlds])

    state = np.random.get_state()[1].tolist()
    first, again, in_processes = numbers(), numbers(), numbers(vectorization="async")
    assert torch.equal(first, again) and torch.equal(first, in_processes)
    assert len(first.unique()) == first.numel() and not torch.equal(first, numbers(seed=2))
    assert np.random.get_state()[1].tolist() == state
