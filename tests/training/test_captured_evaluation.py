"""Evaluations and duels in CUDA graphs: as step by step, and what cannot be captured."""

import pytest
import torch

from megastep import envs
from megastep.agents.networks.policy import Policy
from megastep.agents.selfplay import duels
from megastep.agents.training import evaluation
from megastep.arrdict import arrdict
from megastep.capture import Graph
from megastep.geometries import sample

MAX_STEPS = 150  # eager, graphs, and steps that fill no graph


@pytest.fixture
def recorded(monkeypatch):
    """The graphs that were recorded, and functions that could not be."""
    made, capture_with = [], evaluation.capture_with

    def spied(*args, **options):
        made.append(capture_with(*args, **options))
        return made[-1]

    monkeypatch.setattr(evaluation, "capture_with", spied)
    return made


@pytest.fixture
def step_by_step(monkeypatch):
    """Call it, and nothing is captured from then on."""

    def uncaptured(env, function, *args, **options):
        return function

    return lambda: monkeypatch.setattr(evaluation, "capture_with", uncaptured)


class Waiting:
    """A policy that waits for the GPU in every step, which no CUDA graph can.

    Args:
        policy: chooses the actions.
    """

    def __init__(self, policy):
        self.policy = policy

    def initial(self, n_lanes, device=None):
        return self.policy.initial(n_lanes, device)

    def __call__(self, world, state, **options):
        bool(world["reset"].any())
        return self.policy(world, state, **options)


def explorer():
    return envs.Explorer(128, sample("homes", 8), seed=1, device="cuda", res=16, patience=8)


def deathmatch():
    homes = sample("homes", 8)
    return envs.Deathmatch(32, homes, n_agents=2, seed=1, device="cuda", res=16, limit=120)


def policy_of(env):
    spaces = env.obs_space, env.action_space, env.privileged_space
    return Policy(*spaces, width=64).to(env.device)


def episodes(greedy=False, wrapper=lambda policy: policy):
    env = explorer()
    policy = wrapper(policy_of(env))
    played = evaluation.first_episodes(env, policy, 3, greedy, max_steps=MAX_STEPS)
    assert 0 < played.done.sum() < len(played.done) and played.lengths.max() == MAX_STEPS
    # the environment goes on from the same state
    world = env.step(arrdict(actions=torch.zeros(128, 1, dtype=torch.int64, device="cuda")))
    return arrdict(played, world=world)


def duel(greedy=False):
    env = deathmatch()
    both = policy_of(env), envs.deathmatch.Bot()
    played = duels.play(env, *both, seed=3, greedy=greedy, max_steps=MAX_STEPS)
    assert played.lengths.max() > evaluation.CHECK_EVERY
    return played


def assert_same_bits(left, right):
    (names, leaves), (others, other_leaves) = (
        zip(*sorted(flat(tree)), strict=True) for tree in (left, right)
    )
    assert names == others
    for name, leaf, other in zip(names, leaves, other_leaves, strict=True):
        leaf, other = (values.contiguous().view(-1).view(torch.uint8) for values in (leaf, other))
        assert torch.equal(leaf, other), name


def flat(tree, path=""):
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from flat(value, f"{path}{name}.")
        else:
            yield path + name, value


@pytest.mark.cuda
@pytest.mark.parametrize("greedy", [False, True])
@pytest.mark.parametrize("play", [episodes, duel])
def test_graphs_have_the_bits_of_single_steps(play, greedy, recorded, step_by_step):
    captured = play(greedy)
    (graph,) = recorded
    assert isinstance(graph, Graph)
    step_by_step()
    assert_same_bits(captured, play(greedy))


@pytest.mark.cuda
def test_what_cannot_be_captured_is_evaluated_step_by_step(recorded, step_by_step):
    with pytest.warns(UserWarning, match="without a CUDA graph, slower.*test_captured_evaluation"):
        waited = episodes(wrapper=Waiting)
    (function,) = recorded
    assert not isinstance(function, Graph)
    step_by_step()
    assert_same_bits(waited, episodes())


def test_steps_that_fill_no_graph():
    """Every step is taken once, and none after all is over."""
    for max_steps in (0, 1, 15, 16, 17, 63, 64, 65, 100, 1000):
        taken, is_over = [], torch.zeros(3, dtype=torch.bool)

        def step(world, state, taken=taken, is_over=is_over):
            taken.append((world, state))
            is_over[:] = len(taken) >= 200
            return world + 1, state + 2

        evaluation.step_until(is_over, step, 5, 7, None, (), max_steps)
        n_taken = min(max_steps, 256)  # the first check after 200
        assert taken == [(5 + n, 7 + 2 * n) for n in range(n_taken)]
