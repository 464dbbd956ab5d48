"""Evaluations and duels in CUDA graphs: as step by step, and what cannot be captured."""

import random

import pytest
import torch

from megastep import envs, spaces
from megastep.agents.evaluation import playing
from megastep.agents.networks.policy import Policy
from megastep.agents.selfplay.bots.random import RandomActions
from megastep.arrdict import arrdict
from megastep.capture import Captured, Graph
from megastep.geometries import sample
from tests.helpers import graphs_on_cpu
from tests.helpers.cuda_on_cpu import CudaOnCpu

MAX_STEPS = 150  # eager, graphs, and steps that fill no graph


@pytest.fixture
def recorded(monkeypatch):
    """The graphs that were recorded, and functions that could not be."""
    made, capture_with = [], playing.capture_with

    def spied(*args, **options):
        made.append(capture_with(*args, **options))
        return made[-1]

    monkeypatch.setattr(playing, "capture_with", spied)
    return made


@pytest.fixture
def step_by_step(monkeypatch):
    """Call it, and nothing is captured from then on."""

    def uncaptured(env, policies, function, *args, **options):
        return function

    return lambda: monkeypatch.setattr(playing, "capture_with", uncaptured)


def explorer():
    return envs.Explorer(128, sample("homes", 8), seed=1, device="cuda", res=16, patience=8)


def deathmatch():
    homes = sample("homes", 8)
    return envs.Deathmatch(32, homes, n_agents=2, seed=1, device="cuda", res=16, limit=120)


def policy_of(env):
    env_spaces = env.obs_space, env.action_space, env.privileged_space
    return Policy(*env_spaces, width=64).to(env.device)


def episodes(greedy=False, wrapper=lambda policy: policy):
    env = explorer()
    policy = wrapper(policy_of(env))
    played = playing.first_episodes(env, policy, 3, greedy, max_steps=MAX_STEPS)
    assert 0 < played.done.sum() < len(played.done) and played.lengths.max() == MAX_STEPS
    # the environment goes on from the same state
    world = env.step(arrdict(actions=torch.zeros(128, 1, dtype=torch.int64, device="cuda")))
    return arrdict(played, world=world)


def duel(greedy=False):
    env = deathmatch()
    both = policy_of(env), envs.deathmatch.Bot()
    played = playing.first_duels(env, *both, seed=3, greedy=greedy, max_steps=MAX_STEPS)
    assert played.lengths.max() > playing.CHECK_EVERY
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


# ---- On a CPU, with environments and policies of others ----


class Walk:
    """An environment in PyTorch: actions move along a line. Episodes never end by themselves."""

    n_envs, device = 4, torch.device("cpu")
    obs_space, action_space = spaces.MultiVector(1, 1), spaces.MultiDiscrete(1, 3)

    def reset(self):
        self.place = torch.zeros(4)
        return self.world(torch.zeros(4))

    def step(self, decision):
        self.place = self.place + decision["actions"][:, 0]
        return self.world(self.reward())

    def reward(self):
        return self.place.sin()

    def world(self, reward):
        never = torch.zeros(4, dtype=torch.bool)
        flags = dict(reset=never, terminal=never.clone(), truncated=never.clone())
        return arrdict(obs=self.place.view(4, 1, 1).clone(), reward=reward, **flags)


class Frames(Walk):
    """Keeps its last twenty places, newest first, and swaps two tensors."""

    def __init__(self):
        self.frames, self.odd, self.even = [torch.zeros(4)] * 20, torch.zeros(4), torch.ones(4)
        self.frames = [frame.clone() for frame in self.frames]

    def reward(self):
        self.frames = [self.place.clone(), *self.frames[:-1]]
        self.odd, self.even = self.even, self.odd
        return self.frames[-1] + self.odd

    def world(self, reward):
        return arrdict(super().world(reward), last=self.frames[1])


class Changing(Walk):
    """Its reward depends on something outside tensors, `what`, and how often it has changed."""

    def __init__(self, what):
        self.what, self.n, self.log = what, 0, []

    def reward(self):
        if self.what == "log":
            self.log.append(self.place.clone())
        elif self.what == "random":
            return self.place * random.random()
        elif self.what == "raises":
            if graphs_on_cpu.GraphOnCpu.is_recording:
                raise LookupError("the library cannot do this in a recording")
        else:
            self.n += 1
        return self.place + self.n + len(self.log)


class Own:
    """A policy of another class than megastep's."""

    capturable = True

    def initial(self, n_lanes, device=None):
        return arrdict(age=torch.zeros(n_lanes))

    def __call__(self, world, state, sample=True, generator=None):
        noise = torch.rand(len(state["age"]), 1, generator=generator)
        actions = (self.bias(world) + state["age"])[:, None] % 3 + noise
        return arrdict(actions=actions), arrdict(age=state["age"] + 1)

    def bias(self, world):
        return 0.0


class Silent(Own):
    """Counts steps where no graph sees it, and does not say that it is capturable."""

    capturable = property()  # as if it had none
    age = 0

    def bias(self, world):
        Silent.age += 1
        return Silent.age % 5


class Numbered(Own):
    """Has a number in its hidden state."""

    def initial(self, n_lanes, device=None):
        return dict(age=0)

    def __call__(self, world, state, sample=True, generator=None):
        actions = torch.full((4, 1), float(state["age"] % 7))
        return arrdict(actions=actions), dict(age=state["age"] + 1)


def walk_to_the_end(env, policy):
    random.seed(1)
    played = playing.first_episodes(env, policy, 3, max_steps=MAX_STEPS)
    world = env.step(arrdict(actions=torch.ones(4, 1)))  # goes on from the same state
    return arrdict(played, world=world)


@pytest.fixture
def on_cpu(monkeypatch):
    """Records graphs on a CPU."""
    graphs_on_cpu.install(monkeypatch)
    real = playing.step_until

    def with_tensor_on_gpu(is_over, *rest):
        real(CudaOnCpu.tensor(is_over), *rest)

    for module in (playing,):
        monkeypatch.setattr(module, "step_until", with_tensor_on_gpu)


GRAPHS = {
    "plain": lambda: (Walk(), Own()),
    "random": lambda: (Walk(), RandomActions(Walk.action_space)),
    "frames": lambda: (Frames(), Own()),
}


@pytest.mark.parametrize("case", GRAPHS)
def test_graphs_step_as_the_environments_of_others_do(case, on_cpu, recorded, step_by_step):
    env, policy = GRAPHS[case]()
    before = [value for value in vars(env).values() if not isinstance(value, torch.Tensor)]
    captured = walk_to_the_end(env, policy)
    (graph,) = recorded
    assert isinstance(graph, Graph) and len(graph._graph.operations) > 16
    kept = [value for value in vars(env).values() if not isinstance(value, torch.Tensor)]
    assert all(one is other for one, other in zip(before, kept)) or case == "frames"
    step_by_step()
    assert_same_bits(captured, walk_to_the_end(*GRAPHS[case]()))


def small_policy(env):
    env_spaces = env.obs_space, env.action_space, getattr(env, "privileged_space", None)
    return Policy(*env_spaces, width=16)


@pytest.mark.parametrize(
    "make",
    [
        lambda homes: envs.Explorer(4, homes, device="cpu", resample=False, privileged=True),
        lambda homes: envs.Minimal(4, homes, device="cpu"),
        lambda homes: envs.PointGoal(4, homes, device="cpu"),
        lambda homes: envs.Pong(4, device="cpu", points=50),
    ],
)
def test_evaluations_of_megastep_are_captured(make, on_cpu, monkeypatch, recorded, recwarn):
    graphs_on_cpu.install(monkeypatch, may_wait=True)
    env = make(sample("homes", 4))
    playing.first_episodes(env, small_policy(env), max_steps=70)
    assert isinstance(recorded[0], Graph) and not recwarn.list


def test_duels_of_megastep_are_captured(on_cpu, monkeypatch, recorded, recwarn):
    graphs_on_cpu.install(monkeypatch, may_wait=True)
    env = envs.Deathmatch(4, sample("homes", 4), n_agents=2, device="cpu", res=16)
    playing.first_duels(env, small_policy(env), envs.deathmatch.Bot(), max_steps=70)
    assert isinstance(recorded[0], Graph) and not recwarn.list
    del recorded[:]
    theirs = type("Theirs", (envs.deathmatch.Bot,), {"__module__": "theirs"})
    playing.first_duels(env, small_policy(env), theirs(), max_steps=70)
    assert not recorded


@pytest.mark.parametrize(
    "what, name",
    [
        ("int", "n changed from 64 to 80"),
        ("log", r"log \(its length\) changed"),
        ("random", "the global generator of python changed"),
        ("raises", "cannot do this in a recording"),
    ],
)
def test_what_an_environment_keeps_outside_tensors_is_named(
    what, name, on_cpu, recorded, step_by_step
):
    env = Changing(what)
    with pytest.warns(UserWarning, match=f"without a CUDA graph, slower: .*{name}"):
        refused = walk_to_the_end(env, Own())
    assert not isinstance(recorded[0], Graph)
    step_by_step()
    other = Changing(what)
    assert_same_bits(refused, walk_to_the_end(other, Own()))
    assert len(env.log) == len(other.log) and env.n == other.n


@pytest.mark.parametrize(
    "make",
    [
        lambda: (Walk(), Silent()),
        lambda: (Walk(), Numbered()),
        lambda: (Captured(Walk()), Own()),
    ],
)
def test_what_a_graph_may_not_see_is_not_captured(make, on_cpu, recorded, step_by_step):
    Silent.age = 0
    eager = walk_to_the_end(*make())
    assert not recorded
    step_by_step()
    Silent.age = 0
    assert_same_bits(eager, walk_to_the_end(*make()))
