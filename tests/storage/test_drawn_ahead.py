"""The noise of a rollout's actions, drawn at once: by collectors on a GPU, here on a CPU too."""

import math

import pytest
import torch
from torch.utils import _python_dispatch

from megastep import spaces
from megastep.agents import generator as generators
from megastep.agents.generator import SeededGenerator, draw, drawn_ahead
from megastep.agents.networks.policy import Policy
from megastep.agents.selfplay.mixed_policy import MixedPolicy
from megastep.agents.storage import collector
from megastep.agents.storage.rollout import make_rollout
from megastep.arrdict import arrdict
from megastep.capture import Graph, capture
from tests.helpers import graphs_on_cpu

T, B = 6, 4000
HEADS = {
    "softmax": (spaces.MultiDiscrete(2, 7), {}),
    "dict": (arrdict(a=spaces.MultiDiscrete(1, 3), b=spaces.MultiDiscrete(1, 3)), {}),
    "many": (spaces.MultiDiscrete(1, 40), {}),  # more than the kernel takes
    "gaussian": (spaces.MultiContinuous(1, 2), {}),
    "beta": (spaces.MultiContinuous(1, 2), dict(continuous="beta")),
    "duelling": (spaces.MultiDiscrete(1, 4), dict(output="duelling")),
}
#: Kernels that draw in a rollout: two a rollout and head, but of the Beta distribution one a step.
N_DRAWS = dict(softmax=2, dict=4, many=2, gaussian=2, beta=T, duelling=2)
EXPONENTIAL = torch.Tensor.exponential_


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
def device(request, monkeypatch):
    """Devices where rollouts draw ahead, and graphs can be recorded."""
    if request.param == "cpu":
        graphs_on_cpu.install(monkeypatch, may_wait=True)
        monkeypatch.setattr(collector, "drawn_ahead", lambda n_calls: drawn_ahead(T))
    return torch.device(request.param)


class Still:
    """Shows the same to all lanes at all times."""

    obs_space, n_envs, capturable = spaces.MultiVector(1, 3), B, True

    def __init__(self, device, action_space):
        self.device, self.action_space = device, action_space

    def reset(self):
        flags = dict.fromkeys(
            ("reset", "terminal", "truncated"), torch.zeros(B, device=self.device)
        )
        flags = {name: flag.bool() for name, flag in flags.items()}
        obs = torch.ones(B, 1, 3, device=self.device)
        return arrdict(obs=obs, reward=torch.zeros(B, device=self.device), **flags)

    def step(self, decision):
        return self.reset()


def collector_of(device, head, seed=1):
    """Returns a policy and its collector."""
    space, options = HEADS[head]
    env = Still(device, space)
    policy = Policy(env.obs_space, space, width=16, seed=seed, critic=None, **options).to(device)
    collect = collector.Collector(env, policy, make_rollout(env, policy, T, values=False))
    if head == "duelling":
        policy.output.epsilon = 0.9
    return policy, collect


def actions_of(rollout):
    """Returns the actions, (T, B, n) float32."""
    return torch.cat(
        [leaf.flatten(2).float() for leaf in spaces.leaves(rollout.actions).values()], -1
    )


class Draws(_python_dispatch.TorchDispatchMode):
    """Counts the operations inside that draw random numbers."""

    n = 0

    def __torch_dispatch__(self, operation, types, args=(), options=None):
        self.n += torch.Tag.nondeterministic_seeded in operation.tags
        return operation(*args, **(options or {}))


@pytest.mark.parametrize("head", HEADS)
def test_a_rollout_draws_at_once(device, head):
    _, collect = collector_of(device, head)
    with Draws() as draws:
        collect()
    assert draws.n == N_DRAWS[head]


@pytest.mark.parametrize("head", HEADS)
def test_actions_of_all_steps_are_independent(device, head):
    """Also those of a lane, of an eager rollout, and of the two replays after it."""
    _, collect = collector_of(device, head)
    actions = torch.cat([actions_of(collect()).clone() for _ in range(3)])  # (3 T, B, n)
    assert (collect.graph is not None) == (device.type == "cuda")
    correlations = actions.permute(0, 2, 1).flatten(0, 1).corrcoef()
    n = len(correlations)
    correlations -= torch.eye(n, device=device)
    # of independent numbers, B each, it is 1 / sqrt(B) in the mean square; some 600 are compared
    assert correlations.abs().max() < 5.5 / math.sqrt(B) and n >= 3 * T


@pytest.mark.parametrize("head", HEADS)
def test_the_seed_decides_and_a_rollout_resumes_to_the_bit(device, head):
    """The third rollout is a replay, on a GPU, and an eager one after resuming."""
    policy, collect = collector_of(device, head)
    _, twin = collector_of(device, head)
    resumed_policy, resumed = collector_of(device, head)
    for i in range(4):
        if i == 2:
            saved = policy.generator.state_dict()
            resumed_policy.generator.load_state_dict(saved, device)
            resumed.load_state_dict(collect.state_dict())
        expected = actions_of(collect())
        assert torch.equal(actions_of(twin()), expected)
        assert i < 2 or torch.equal(actions_of(resumed()), expected)
    assert all((one.graph is not None) == (device.type == "cuda") for one in (collect, resumed))
    other = collector_of(device, head, seed=2)[1]
    assert not torch.equal(actions_of(other()), expected)


def test_policies_of_one_generator_do_not_share_numbers(device):
    """Nor does a policy that acts twice."""
    policy, _ = collector_of(device, "gaussian")
    lanes = torch.arange(B, device=device).split(B // 4)
    mixed = MixedPolicy([policy, policy.actor(), policy, policy.actor()], lanes)
    world, state = Still(device, None).reset(), mixed.initial(B, device)
    generator, actions = SeededGenerator(1).on(device), []
    with torch.no_grad(), drawn_ahead(T):
        for _ in range(2 * T):  # longer than planned
            decision, _ = mixed(world, state, generator=generator)
            actions += decision["actions"].flatten(1)[:, :1].chunk(4)
    # some float32 are equal by chance
    assert len(torch.cat(actions).unique()) > 0.99 * 2 * T * B


FILLS = {
    torch.Tensor.uniform_: (0.5, 1 / 12),
    torch.Tensor.normal_: (0.0, 1.0),
    EXPONENTIAL: (1.0, 1.0),
}


@pytest.mark.parametrize("fill", FILLS)
def test_numbers_have_their_distribution(device, fill):
    generator, (mean, variance) = SeededGenerator(1).on(device), FILLS[fill]
    with drawn_ahead(T):
        numbers = torch.stack([draw(fill, fill, (B, 5), generator, device) for _ in range(T)])
    each = numbers.flatten(1).double()
    standard_error = math.sqrt(variance / (5 * B))
    assert ((each.mean(1) - mean).abs() < 5 * standard_error).all()
    # the kurtosis is at most 9
    assert ((each.var(1) / variance - 1).abs() < 5 * math.sqrt(8 / (5 * B))).all()


def test_owners_use_up_blocks_of_their_own(device, monkeypatch):
    """Three blocks each for six calls; a limit on their size; nothing ahead outside."""
    monkeypatch.setattr(generators, "_MAX_NUMBERS", 40)
    generator, plain, other = (SeededGenerator(seed).on(device) for seed in (1, 1, 2))
    for shape, rows in ((3, 4), 4), ((3, 5), 3):
        with drawn_ahead(5):
            draw("a", EXPONENTIAL, shape, other, device)
            ours = [
                [draw(owner, EXPONENTIAL, shape, generator, device) for owner in "ab"]
                for _ in range(6)
            ]
        blocks = [torch.empty(n, *shape, device=device) for n in (1, 1, *[rows] * 4)]
        for block in blocks:
            block.exponential_(generator=plain)
        for first, theirs in enumerate(zip(*ours, strict=True)):
            assert torch.equal(torch.stack(theirs), torch.cat(blocks[first::2])[:6])
        one = torch.empty(shape, device=device).exponential_(generator=plain)
        assert torch.equal(draw("a", EXPONENTIAL, shape, generator, device), one)


def test_shapes_that_change_take_no_more_numbers(device):
    """Such as those of a policy that acts for some lanes, in an environment on the host."""
    generator, plain = (SeededGenerator(1).on(device) for _ in range(2))
    with drawn_ahead(T):
        for n in range(1, T):
            numbers = draw("a", EXPONENTIAL, (n,), generator, device)
            assert torch.equal(numbers, torch.empty(n, device=device).exponential_(generator=plain))


def test_a_graph_that_is_recorded_meanwhile_draws_for_itself(device):
    """Such as that of an environment with a policy inside, in a rollout that runs eagerly."""
    state = arrdict(generator=SeededGenerator(1).on(device), total=torch.zeros(3, device=device))

    def step():
        state["total"] += draw(0, EXPONENTIAL, (3,), state["generator"], device)

    totals = [state["total"].clone()]
    with drawn_ahead(T):
        step()
        graph = capture(step, (), (state,))
        for _ in range(3):
            totals.append(state["total"].clone())
            graph()
    assert isinstance(graph, Graph)
    totals.append(state["total"].clone())
    assert len(torch.stack(totals).diff(dim=0).unique()) == 3 * 4


def test_cpus_draw_step_by_step():
    """So that a run has the bits that it had before."""
    policy, collect = collector_of(torch.device("cpu"), "gaussian")
    generator = SeededGenerator(policy.generator.seed).on(policy.device)
    world, state = Still(policy.device, None).reset(), policy.initial(B)
    for actions in collect().actions:
        decision, state = policy(world, state, generator=generator)
        assert torch.equal(decision["actions"], actions)
