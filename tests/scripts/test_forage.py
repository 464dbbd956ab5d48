"""The example environment with objects keeps the contract, and its food adds up."""

import torch
from forage import BLUE, GREEN, Forage, Forager

from megastep import contract
from megastep.geometries import sample

N, A = 16, 2


def test_it_keeps_the_contract():
    contract.rollout(Forage(8, sample("homes", 4), device="cpu", limit=10), 30)


def test_food_is_carried_home_one_piece_at_a_time_and_grows_back():
    env = Forage(N, device="cpu", n_agents=A, food=4, limit=200)
    bot, world = Forager(env), env.reset()
    state, paid = bot.initial(N * A), torch.zeros(N)
    for _ in range(199):
        held = env.food.carried().any(-1)  # (N, A)
        decision, state = bot(world, state)
        world = env.step(decision)
        reward = world.reward.view(N, A)
        paid += reward.sum(1)
        assert not (reward.bool() & ~held).any(), "only who carries food is paid"
        assert (env.food.carried().sum(-1) <= 1).all()
        assert env.food.visible.all() and env.nest.visible.all()
        assert torch.equal(env.carried_home, paid)
        carrying = world.obs.carrying.view(N, A).bool()
        assert torch.equal(carrying, env.food.carried().any(-1))
    assert paid.mean() > 0.5
    assert world.metrics.food.view(N, A)[:, 0].equal(paid)
    assert (env.food.colours == GREEN).all() and (env.nest.colours == BLUE).all()
    env.step(decision)
    world = env.step(decision)  # the next episode has begun
    assert not env.carried_home.any()
