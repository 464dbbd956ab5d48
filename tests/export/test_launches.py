"""A policy as launches of plain kernels acts as it does in PyTorch."""

import pytest
import torch

from megastep import spaces
from megastep.agents.errors import UserError
from megastep.agents.export.launches import add_policy
from megastep.agents.networks.policy import Policy
from megastep.arrdict import arrdict
from megastep.dotdict import leaves
from megastep.web.program import Buffer, Leaf, Program, Ref, Replay
from tests.export.test_export import IMAGE, MANY, VECTOR, Noise

GRID = arrdict(
    image=spaces.MultiImage(2, 3, 4, 5, dtype=torch.uint8), to=spaces.MultiDiscrete(2, 4)
)
MOVE = spaces.MultiDiscrete(2, 7)
#: Every core and encoder of a page: spaces, and settings of the policy.
KINDS = {
    "lstm": (MANY, MOVE, dict(encoder="conv")),
    "mingru": (MANY, MOVE, dict(core="mingru", layers=2, encoder="cnn")),
    "grid": (GRID, MOVE, dict(core="mingru", encoder="categories")),
    "none": (VECTOR, MOVE, dict(core="none", activation="tanh", width=30)),
}


def program_of(env, action_space, n_lanes):
    """Returns a program without kernels, whose world has the leaves of an environment."""
    world = env.step(None)
    values = {"actions": torch.zeros(n_lanes, *action_space.shape, dtype=torch.int64)}
    values |= spaces.leaves(world)
    program = Program(Leaf(Ref(0), (), (), torch.int64))
    for path, value in values.items():
        program.buffers.append(Buffer(value.nbytes))
        ref = Ref(len(program.buffers) - 1)
        program.world[path] = Leaf(ref, tuple(value.shape), value.stride(), value.dtype)
    program.actions = program.world.pop("actions")
    return program


def made(kind):
    """Returns a policy with weights that matter, its environment, and what replays it."""
    obs_space, action_space, options = KINDS[kind]
    env = Noise(obs_space)
    policy = Policy(obs_space, action_space, **{"width": 32, **options})
    for _ in range(3):
        policy.update_stats(env.step(None)["obs"])
    with torch.no_grad():
        for weight in policy.output.parameters():
            weight.mul_(20)
    program = program_of(env, action_space, env.n_envs)
    acting = [
        add_policy(program, policy, lanes, f"p{lanes.start}") for lanes in (range(1), range(1, 3))
    ]
    return policy, env, program, acting


@torch.no_grad()
@pytest.mark.parametrize("kind", KINDS)
def test_launches_act_as_the_policy(kind):
    """Greedily, in two parts of the lanes, with episodes that end at different times."""
    policy, env, program, acting = made(kind)
    for launch in program.launches:
        if "greedy" in launch.values:
            launch.values["greedy"] = 1
    replay, state = Replay(program), policy.initial(3)
    for _ in range(60):
        world = env.step(None)
        for path, leaf in spaces.leaves(world).items():
            replay.tensor(program.world[path]).copy_(leaf)
        decision, state = policy(world, state, sample=False)
        for part in acting:
            replay.run(part.section)
        logits = torch.cat([replay.tensor(part.logits) for part in acting])
        scale = max(1, decision.logits.abs().max().item())
        torch.testing.assert_close(logits, decision.logits, rtol=0, atol=1e-5 * scale)
        actions, best = replay.tensor(program.actions), decision.logits.topk(2).values
        is_clear = best[..., 0] - best[..., 1] > 2e-5 * scale
        assert torch.equal(actions[is_clear], decision.actions[is_clear])
        hidden = [
            torch.cat(parts)
            for parts in zip(*([replay.tensor(s) for s in p.states] for p in acting))
        ]
        for own, theirs in zip(hidden, leaves(state), strict=True):
            torch.testing.assert_close(own, theirs, rtol=0, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("kind", KINDS)
def test_samples_have_the_distribution(kind):
    """The mean over 4,000 draws, against the policy's, within five standard errors."""
    policy, env, program, acting = made(kind)
    replay, world, n = Replay(program), env.step(None), 4000
    world["reset"].fill_(True)
    for path, leaf in spaces.leaves(world).items():
        replay.tensor(program.world[path]).copy_(leaf)
    decision, _ = policy(world, policy.initial(3), sample=False)
    generator = torch.Generator().manual_seed(1)
    logits = decision.logits.expand(n, *decision.logits.shape)
    expected = policy.output.sample(logits, generator).double()
    drawn = torch.empty_like(expected)
    for i in range(n):
        replay.run(acting[0].section)
        drawn[i, 0] = replay.tensor(program.actions)[0].double()
    error = (expected[:, 0].var(0) + drawn[:, 0].var(0)).div(n).sqrt() + 1e-6
    assert ((drawn[:, 0].mean(0) - expected[:, 0].mean(0)).abs() < 5 * error).all()
    spread = drawn[:, 0].std(0), expected[:, 0].std(0)
    torch.testing.assert_close(*spread, rtol=0.1, atol=0.05)


def test_cores_encoders_and_actions_of_the_users_are_refused():
    space = {"move": MOVE}
    for settings, sentence in (
        (dict(core="tests.export.test_launches:Odd"), "no recurrent core Odd; it has"),
        (dict(encoder="tests.export.test_launches:Mean"), "no encoder Mean; it has"),
        (dict(core="gru"), "no recurrent core GRU; it has agent.core=lstm, mingru, none"),
        (dict(output="duelling"), "no DuellingOutput: it has discrete actions of one kind"),
        (dict(), "discrete actions of one kind"),
    ):
        action_space = MOVE if settings else space
        policy = Policy(IMAGE, action_space, width=8, **settings)
        program = program_of(Noise(IMAGE), MOVE, 3)
        with pytest.raises(UserError, match=sentence):
            add_policy(program, policy, range(3))


class Mean(torch.nn.Module):
    """An encoder of one number."""

    n_features = 1

    def __init__(self, space):
        super().__init__()

    def forward(self, obs):
        return obs.flatten(-4).mean(-1, keepdim=True)


class Odd(torch.nn.Module):
    """A core without a state."""

    def __init__(self, width):
        super().__init__()

    def initial(self, n_lanes, device=None):
        return arrdict()

    def forward(self, x, reset, state):
        return x, state
