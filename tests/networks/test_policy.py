"""The policy: steps match an unroll over the sequence, and a seed determines everything."""

import copy

import pytest
import torch

from megastep import spaces
from megastep.agents.generator import SeededGenerator
from megastep.agents.networks.cores import CORES
from megastep.agents.networks.policy import Policy
from megastep.arrdict import arrdict, stack
from megastep.dotdict import leaves, mapping
from tests.helpers.weights import reloaded, same

T, B = 7, 5
OBS = arrdict(rgb=spaces.MultiImage(1, 3, 1, 16), imu=spaces.MultiVector(1, 3))
PRIVILEGED = spaces.MultiVector(1, 12)
MOVES = arrdict(movement=spaces.MultiDiscrete(1, 7), fire=spaces.MultiDiscrete(1, 2))


def worlds(obs_space=OBS, dtype=torch.float16, seed=0):
    generator = torch.Generator().manual_seed(seed)
    obs = obs_space.map(lambda space: torch.rand(T, B, *space.shape, generator=generator).to(dtype))
    return arrdict(obs=obs, reset=torch.rand(T, B, generator=generator) < 0.3)


def act(policy, world, **options):
    """Acts step by step. Returns the decisions and the last hidden state."""
    state, decisions = policy.initial(B), []
    for t in range(T):
        decision, state = policy(world[t], state, **options)
        decisions.append(decision)
    return stack(decisions), state


@pytest.mark.parametrize("layers", [1, 3])
@pytest.mark.parametrize("core", CORES)
def test_steps_match_unroll_for_every_core(core, layers):
    policy, world = Policy(OBS, MOVES, width=16, core=core, layers=layers), worlds()
    decisions, state = act(policy, world)
    unrolled = policy.unroll(world.obs, world.reset, policy.initial(B))
    close = dict(rtol=1e-5, atol=1e-5)  # as above
    torch.testing.assert_close(decisions.features, unrolled.features, **close)
    for leaf, expected in zip(leaves(state), leaves(unrolled.state), strict=True):
        torch.testing.assert_close(leaf, expected, **close)


@pytest.mark.parametrize("core", CORES)
def test_act_carries_the_hidden_state(core):
    policy, world = Policy(OBS, MOVES, width=16, core=core), worlds()
    decisions = [policy.act(world[t], greedy=True).logits.movement for t in range(T)]
    expected, _ = act(policy, world, sample=False)
    assert torch.equal(torch.stack(decisions), expected.logits.movement)
    assert len(policy.act(world[0].map(lambda leaf: leaf[:2])).actions.fire) == 2


@pytest.mark.parametrize("core", CORES)
def test_burn_in_only_warms_up_the_hidden_state(core, device):
    policy, world = Policy(OBS, MOVES, width=16, core=core).to(device), worlds()
    world = world.map(lambda leaf: leaf.to(device))
    sequence = world.obs, world.reset, policy.initial(B)
    whole, rest = policy.unroll(*sequence), policy.unroll(*sequence, burn_in=3)
    with torch.no_grad():
        in_one_pass = policy.unroll(*sequence, burn_in=3)
    close = dict(rtol=1e-5, atol=1e-5) if device == "cpu" else dict(rtol=2e-2, atol=2e-2)
    for part in rest, in_one_pass:
        torch.testing.assert_close(part.features, whole.features[3:], **close)
        torch.testing.assert_close(
            part.logits.movement, whole.logits.movement[3:], check_dtype=False, **close
        )
        for leaf, expected in zip(leaves(part.state), leaves(whole.state), strict=True):
            torch.testing.assert_close(leaf, expected, **close)
    # weights that the burn-in used still have gradients, those of the other steps
    state = policy.warm_up(*(leaf[:3] for leaf in (world.obs, world.reset)), policy.initial(B))
    alone = policy.unroll(*(leaf[3:] for leaf in (world.obs, world.reset)), state)
    weights = [p for name, p in policy.named_parameters() if name.startswith(("intake", "core"))]
    gradients = (
        torch.autograd.grad(part.features.square().sum(), weights) for part in (rest, alone)
    )
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, **close)


def test_seed_determines_weights_and_actions():
    before = torch.get_rng_state()
    first, second, other = (
        act(Policy(OBS, MOVES, width=32, seed=seed), worlds())[0] for seed in (1, 1, 2)
    )
    assert torch.equal(before, torch.get_rng_state())
    assert torch.equal(first.actions.movement, second.actions.movement)
    assert torch.equal(first.logits.movement, second.logits.movement)
    assert not torch.equal(first.logits.movement, other.logits.movement)
    assert not torch.equal(first.actions.movement, other.actions.movement)


def test_weights_of_a_seed_are_the_same_with_any_number_of_threads():
    policies, n_threads = [], torch.get_num_threads()
    try:
        for n in (1, 2, 4):
            torch.set_num_threads(n)
            policies.append(Policy(OBS, MOVES, PRIVILEGED, width=256).state_dict())
            assert torch.get_num_threads() == n
    finally:
        torch.set_num_threads(n_threads)
    assert all(same(policies[0], policy) for policy in policies)


def test_weights_load_with_weights_only():
    policy, twin = Policy(OBS, MOVES, width=32, seed=1), Policy(OBS, MOVES, width=32, seed=2)
    policy.critic.output.update_stats(torch.tensor([1.0, 9.0]), torch.tensor([True, True]))
    twin.load_state_dict(reloaded(policy.state_dict()))
    world = worlds()
    outputs, expected = (p.unroll(world.obs, world.reset, p.initial(B)) for p in (policy, twin))
    assert torch.equal(policy.value(outputs.features), twin.value(expected.features))
    assert torch.equal(outputs.logits.fire, expected.logits.fire)


def test_generator_resumes():
    generator, cpu = SeededGenerator(3), torch.device("cpu")
    unused = generator.state_dict()
    start = torch.rand(4, generator=generator.on(cpu))
    saved = generator.state_dict()
    rest = torch.rand(4, generator=generator.on(cpu))
    other = SeededGenerator(8)
    other.load_state_dict(saved, cpu)
    assert torch.equal(torch.rand(4, generator=other.on(cpu)), rest)
    other.load_state_dict(unused, cpu)
    assert torch.equal(torch.rand(4, generator=other.on(cpu)), start)
    # a GPU's state means nothing on a CPU: starts again from the seed
    other.load_state_dict({**saved, "device": "cuda"}, cpu)
    assert torch.equal(torch.rand(4, generator=other.on(cpu)), start)


def learnt(policy, world, privileged, lanes, weights):
    """Returns what learning computes from a sequence of some lanes, and the gradients of a random
    sum of it, each on the CPU by name.
    """
    starts, state = world.reset[:, lanes], policy.initial(len(lanes))
    now = policy.unroll(mapping(lambda leaf: leaf[:, lanes])(world.obs), starts, state)
    # the same actions whatever the logits are
    actions = mapping(lambda leaf: (weights[0] > 0).long()[..., None])(now.logits)
    outputs = policy.terms(world.obs, starts, state, actions, privileged, lanes)
    outputs.pop("features")
    assert all(output.dtype == torch.float32 for output in outputs.values())
    sum((w * output).sum() for w, output in zip(weights, outputs.values())).backward()
    gradients = {name: p.grad for name, p in policy.named_parameters()}
    results = {**outputs, "features": now.features, **gradients}
    return {name: leaf.detach().float().cpu() for name, leaf in results.items()}


def test_terms_are_those_of_an_unroll():
    policy, world = Policy(OBS, MOVES, PRIVILEGED, width=32), worlds()
    state, generator = policy.initial(B), torch.Generator().manual_seed(1)
    privileged = torch.randn(T, B, *PRIVILEGED.shape, generator=generator)
    now = policy.unroll(world.obs, world.reset, state)
    actions = policy.output.sample(now.logits, generator)
    terms = policy.terms(world.obs, world.reset, state, actions, privileged)
    expected = dict(
        logprobs=policy.output.logprob(now.logits, actions),
        entropies=policy.output.entropy(now.logits),
        errors=policy.prediction_error(now.features, privileged),
        values=policy.value(now.features, privileged),
    )
    assert terms.keys() == {*expected, "features"}
    for name, leaf in expected.items():
        torch.testing.assert_close(terms[name], leaf, msg=name)
    plain = Policy(OBS, MOVES, width=32)
    assert plain.terms(world.obs, world.reset, state, actions).errors is None


def relative_error(one, other):
    return ((one - other).norm() / other.norm()).item()


@pytest.mark.cuda
@pytest.mark.parametrize("moves", [MOVES, spaces.MultiDiscrete(1, 7)])
@pytest.mark.parametrize("layers", [1, 3])
@pytest.mark.parametrize("core", CORES)
def test_bf16_policy_on_a_gpu_matches_the_plain_forms_in_float32(core, layers, moves):
    """What learning computes, for some lanes. The LSTM of 256 units runs on chip; with actions of
    one kind, the heads are computed together.
    """
    n_steps, n_lanes = 9, 45
    generator = torch.Generator().manual_seed(0)

    def draw(space):
        return torch.rand(n_steps, n_lanes, *space.shape, generator=generator).half()

    world = arrdict(
        obs=OBS.map(draw), reset=torch.rand(n_steps, n_lanes, generator=generator) < 0.2
    )
    privileged = draw(PRIVILEGED).float()
    lanes = torch.randperm(n_lanes, generator=generator)[:37]
    weights = torch.randn(4, n_steps, len(lanes), generator=generator)
    plain = Policy(OBS, moves, PRIVILEGED, core=core, layers=layers)
    outputs = plain.output.outputs.values() if moves is MOVES else [plain.output]
    with torch.no_grad():
        for output in outputs:
            output.linear.weight.mul_(100)  # far from uniform
    plain.update_stats(world[0].obs, privileged[0])
    fused = copy.deepcopy(plain).cuda()
    expected = learnt(plain, world, privileged, lanes, weights)
    on_gpu = (leaf.cuda() for leaf in (world, privileged, lanes, weights))
    for name, leaf in learnt(fused, *on_gpu).items():
        assert leaf.shape == expected[name].shape
        # a number in bfloat16 is off by up to 0.2 %, and each layer and step adds to that; a ReLU
        # whose input is near 0 may pass a gradient in one of both forms only
        limit = 0.2 if name in dict(plain.named_parameters()) else 0.03
        assert relative_error(leaf, expected[name]) < limit, name
