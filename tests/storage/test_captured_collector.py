"""Collectors in CUDA graphs that are recorded on a CPU: megastep's own parts are never refused, and
what users keep outside tensors is.
"""

import warnings

import numpy as np
import pytest
import torch

from megastep import envs
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.networks.policy import Policy
from megastep.agents.selfplay.opponents import Opponents
from megastep.capture import Graph
from megastep.geometries import sample
from tests.helpers import graphs_on_cpu


def homes():
    return sample("homes", 4)


ENVS = {
    "explorer": lambda: envs.Explorer(6, homes(), device="cpu", resample=True, privileged=True),
    "minimal": lambda: envs.Minimal(6, homes(), device="cpu"),
    "pointgoal": lambda: envs.PointGoal(6, homes(), device="cpu", privileged=True),
    "deathmatch": lambda: envs.Deathmatch(6, homes(), n_agents=2, device="cpu", privileged=True),
    "pong": lambda: envs.Pong(6, device="cpu", self_play=True),
    "minatar": lambda: envs.MinAtar(6, device="cpu"),
}


def policy_for(env, **agent):
    env_spaces = env.obs_space, env.action_space, getattr(env, "privileged_space", None)
    return Policy(*env_spaces, width=16, **agent)


def collected(env, policy, monkeypatch):
    """Returns the graph after three rollouts, and the warnings."""
    graphs_on_cpu.install(monkeypatch, may_wait=True)
    collect = PPO(policy, n_steps=4, n_minibatches=1).collector(env)
    collect.can_capture = True
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(3):
            collect()
    return collect.graph, [str(one.message) for one in caught]


@pytest.mark.parametrize("name", ENVS)
def test_environments_of_megastep_are_captured(name, monkeypatch):
    env = ENVS[name]()
    graph, messages = collected(env, policy_for(env), monkeypatch)
    assert isinstance(graph, Graph) and not messages


@pytest.mark.parametrize(
    "agent", [dict(core="mingru"), dict(core="gru", layers=2), dict(core="none")]
)
def test_cores_of_megastep_are_captured(agent, monkeypatch):
    env = ENVS["explorer"]()
    graph, messages = collected(env, policy_for(env, **agent), monkeypatch)
    assert isinstance(graph, Graph) and not messages


def test_opponents_are_captured(monkeypatch):
    env = ENVS["deathmatch"]()
    policy = policy_for(env)
    shares = dict(past=0.5, bot=0.5, snapshots=1, every=1)
    env = Opponents(env, policy, envs.deathmatch.Bot(), **shares)
    graph, messages = collected(env, policy, monkeypatch)
    assert isinstance(graph, Graph) and not messages


def test_a_rollout_starts_where_the_last_ended_although_a_recording_steps_too(monkeypatch):
    graphs_on_cpu.install(monkeypatch, may_wait=True)
    env = ENVS["minimal"]()
    collect = PPO(policy_for(env), n_steps=4, n_minibatches=1).collector(env)
    collect.can_capture = True
    ended = collect().obs[-1].clone()
    started = collect().obs[0]
    assert isinstance(collect.graph, Graph) and torch.equal(started, ended)


class Tired(envs.Minimal):
    """Counts its steps in an array of NumPy."""

    def __init__(self, *args, **settings):
        super().__init__(*args, **settings)
        self.n_steps = np.zeros(1, int)

    def step(self, decision):
        self.n_steps += 1
        world = super().step(decision)
        world["reward"] = world.reward - float(self.n_steps[0])
        return world


def test_an_array_that_counts_steps_is_refused(monkeypatch):
    env = Tired(6, homes(), device="cpu")
    graph, messages = collected(env, policy_for(env), monkeypatch)
    assert not isinstance(graph, Graph) and "n_steps changed during the call" in messages[0]
    assert env.n_steps == 3 * 4 and len(messages) == 1
