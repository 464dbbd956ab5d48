"""The scripted bot of Deathmatch: what it does near agents and walls, and that it beats random
actions.
"""

import pytest
import torch
from test_deathmatch import Ring

from megastep import arrdict, capture, contract, envs, toys
from megastep.agents.selfplay.bots.random import RandomActions
from megastep.envs.deathmatch.bot import Bot
from megastep.envs.pong import Tracker
from megastep.geometries import sample
from tests.helpers import bot_twin
from tests.helpers.bot_twin import NOTHING
from tests.helpers.synchronisation import no_synchronisation


def ring(device, *poses, **settings):
    """An environment with agents at (x, y, degrees) in a box from 1 to 6, and its first world."""
    ring = Ring(device, *poses, **settings)
    return ring.env, ring.step()


@pytest.mark.parametrize("bearing", [25, -25, 8, 0])
def test_keeps_a_target_at_the_centre(bearing, device):
    """At two metres an agent is four degrees wide, and a turn takes fourteen. It must hit in more
    than half of 60 steps, which include the first turn.
    """
    target = (4.0, 3.5, 0.0)
    env, world = ring(device, (2.0, 3.5, -bearing), target, damage=0)
    bot, hits = Bot(), 0
    state = bot.initial(2, env.device)
    for _ in range(60):
        decision, state = bot(world, state)
        decision.actions[1] = NOTHING
        world = env.step(decision)
        hits += float(world.reward[0])
    assert hits > 30


def test_other_observations_are_refused():
    env = envs.Pong(2, device="cpu")
    with pytest.raises(ValueError, match="rgb, d and imu"):
        Bot()(env.reset(), Bot().initial(2))


def test_beats_random_actions():
    """First deaths of 32 duels; the bot is the first agent in half of them."""
    env = envs.Deathmatch(32, [toys.box()], n_agents=2, device="cpu")
    players = Bot(), RandomActions(env.action_space)
    mine = torch.arange(64) % 2 == torch.arange(64) // 32  # lanes that the bot plays
    states = [player.initial(64, "cpu") for player in players]
    world, won, over = env.reset(), torch.zeros(32), torch.zeros(32, dtype=torch.bool)
    generator = torch.Generator().manual_seed(1)
    for _ in range(300):
        acts = []
        for i, player in enumerate(players):
            decision, states[i] = player(world, states[i], generator=generator)
            acts.append(decision.actions)
        world = env.step(arrdict.arrdict(actions=torch.where(mine[:, None], *acts)))
        dead = world.terminal.view(32, 2)
        ours = (dead & mine.view(32, 2)).any(1)
        won += ((dead.any(1) & ~ours) & ~over).float()
        over |= dead.any(1)
    assert won.mean() > 0.9


@pytest.mark.parametrize("res, fov", [(512, 70), (508, 130), (96, 20)])
def test_acts_as_its_twin_does(res, fov, device):
    """In homes, from many states. Ties may go either way, such as halves of equal mean depth."""
    env = envs.Deathmatch(64, sample("homes", 8), n_agents=4, device=device, res=res, fov=fov)
    generator, world, bot = torch.Generator().manual_seed(0), env.reset(), Bot(fov)
    for step in range(40):
        if step % 8 == 0:
            ranges = dict(lost=30, side=2, around=4, pushed=2)
            state = {
                name: torch.randint(high, (256,), generator=generator).to(env.device)
                for name, high in ranges.items()
            }
            state["side"] = 2 * state["side"] - 1
            state["pushed"] = state["pushed"].bool()
        expected, after = bot_twin.act(world, state, fov)
        decision, state = bot(world, state)
        is_same = (decision.actions == expected.actions).all(1)
        for name, leaf in state.items():
            assert leaf.dtype == after[name].dtype
            is_same &= leaf == after[name]
        assert is_same.float().mean() > 0.99
        world = env.step(decision)


def test_cuda_kernel_on_a_cpu_acts_as_the_cpu_does(cuda_on_cpu, monkeypatch):
    env = envs.Deathmatch(16, sample("homes", 8), n_agents=4, device="cpu")
    bot, world = Bot(), env.reset()
    states = [bot.initial(64), bot.initial(64)]
    for _ in range(20):
        decision, states[0] = bot(world, states[0])
        with monkeypatch.context() as patch:
            cuda_on_cpu.install(patch)
            theirs, states[1] = bot(world, states[1])
        assert contract.same(decision, theirs) and contract.same(*states)
        world = env.step(decision)
    assert "bot" in cuda_on_cpu.launched


@pytest.mark.cuda
def test_gpu_acts_as_the_cpu_does():
    env = envs.Deathmatch(64, sample("homes", 8), n_agents=4, device="cuda")
    bot, world = Bot(), env.reset()
    state, on_cpu = bot.initial(256, "cuda"), bot.initial(256, "cpu")
    for _ in range(60):
        seen = arrdict.arrdict(obs=world.obs.map(torch.Tensor.cpu), reset=world.reset.cpu())
        decision, state = bot(world, state)
        expected, on_cpu = bot(seen, on_cpu)
        assert torch.equal(decision.actions.cpu(), expected.actions)
        for name, leaf in state.items():
            assert torch.equal(leaf.cpu(), on_cpu[name]), name
        world = env.step(decision)


@pytest.mark.cuda
@pytest.mark.parametrize("bot", [Bot(), Tracker()])
def test_bots_never_synchronise_and_can_be_captured(bot):
    if isinstance(bot, Bot):
        env = envs.Deathmatch(8, [toys.box()], device="cuda")
    else:
        env = envs.Pong(8, device="cuda", self_play=True)
    world = env.reset()
    state = bot.initial(len(world.reset), "cuda")
    bot(world, state)
    with no_synchronisation():
        plain, _ = bot(world, state)
    graph = capture.capture(lambda world, state: bot(world, state), (world, state), ())
    assert isinstance(graph, capture.Graph)
    assert torch.equal(graph(world, state)[0].actions, plain.actions)
