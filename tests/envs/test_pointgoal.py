"""PointGoal's rules, each by hand: what is paid, when an episode ends, what its metrics are."""

import numpy as np
import pytest
import torch
from test_geodesics import room

from megastep import arrdict, contract, envs
from megastep.geometries import sample

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
FORWARD, LEFT = 3, 1


@pytest.fixture(params=DEVICES)
def device(request):
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    return request.param


def made(device="cpu", n_envs=4, geometries=None, **settings):
    geometries = [room(width=8.0)] if geometries is None else geometries
    return envs.PointGoal(n_envs, geometries, device=device, res=8, subsample=1, **settings)


def decided(env, action):
    actions = torch.full((env.n_envs, 1), action, device=env.device)
    return arrdict.arrdict(actions=actions)


def place(env, metres):
    """Puts each agent `metres` west of its goal, at rest, looking at it, in mid-episode."""
    goals = env.goals.points[env.layout.long(), env.goal_index.long()]
    agents = env.core.agents
    agents.positions[:, 0] = goals - torch.tensor([metres, 0.0], device=env.device)
    agents.velocity.zero_()
    agents.angles.zero_()
    agents.angvelocity.zero_()
    env.progress[:2] = agents.positions[:, 0].T


def test_a_metre_nearer_pays_one_and_a_step_costs():
    """In an empty room, in front of whose eastern side the goal is pushed; 0.5 m/s is 5 cm."""
    env = made(cost=0.02)
    env.reset()
    place(env, 0.6)
    env.step(decided(env, 0))
    before = env.progress[2].clone()
    world = env.step(decided(env, FORWARD))
    torch.testing.assert_close(world.reward, before - env.progress[2] - 0.02)
    torch.testing.assert_close(world.reward + 0.02, torch.full((4,), 0.05), atol=0.01, rtol=0)
    away = env.step(decided(env, 4))  # back: at rest again, almost
    assert (away.reward.abs() < 0.03).all()


def test_within_two_decimetres_the_episode_ends_with_a_bonus(device):
    env = made(device, bonus=7.0, cost=0.5)
    env.reset()
    place(env, 0.27)
    world = env.step(decided(env, FORWARD))
    assert not world.terminal.any(), "0.22 m"
    world = env.step(decided(env, FORWARD))
    assert world.terminal.all() and not world.truncated.any() and (world.metrics.success == 1).all()
    assert ((world.reward > 6.4) & (world.reward < 6.7)).all(), "and some centimetres"
    after = env.step(decided(env, FORWARD))
    assert after.reset.all() and not after.reward.any() and not after.terminal.any()
    assert not env.progress[5].any() and not env.progress[6].any()


def test_an_episode_is_truncated_at_its_limit():
    env = made(limit=3)
    worlds = [env.reset(), *(env.step(decided(env, 0)) for _ in range(3))]
    assert [bool(w.truncated.any()) for w in worlds] == [False, False, False, True]
    assert not worlds[-1].metrics.success.any() and not worlds[-1].metrics.spl.any()


def test_spl_is_the_shortest_over_the_walked(device):
    """Two metres are walked instead of one, and then half of one."""
    env = made(device)
    env.reset()
    for walked, spl in ((2.0, 0.5), (0.5, 1.0)):
        place(env, 0.23)
        env.progress[4].fill_(1.0)
        env.progress[5].fill_(walked - 0.05)
        world = env.step(decided(env, FORWARD))
        assert world.terminal.all()
        np.testing.assert_allclose(world.metrics.spl.cpu(), spl, rtol=1e-4)
        np.testing.assert_allclose(world.metrics.soft_spl.cpu(), spl, rtol=1e-4)
        env.step(decided(env, 0))


def test_soft_spl_pays_for_the_part_of_the_way_that_was_made():
    env = made(limit=2)
    env.reset()
    place(env, 1.0)
    env.step(decided(env, 0))
    env.progress[3].copy_(env.progress[2] * 4)
    env.progress[4].fill_(2.0)
    env.progress[5].fill_(5.0)
    world = env.step(decided(env, 0))
    assert world.truncated.all() and not world.metrics.spl.any()
    np.testing.assert_allclose(world.metrics.soft_spl, 0.75 * 0.4, rtol=1e-3)


def test_what_is_walked_is_the_sum_of_steps_and_collisions_are_counted(device):
    """Random walks, added up from the positions; a step that a wall cut short leaves no speed."""
    env = made(device, 16, [room(width=1.2, height=1.2)], nearest=0.3, limit=40)
    world, walked, hits = env.reset(), torch.zeros(16), torch.zeros(16)
    generator, n_ends = torch.Generator().manual_seed(1), 0
    before = env.core.agents.positions.clone()
    for _ in range(120):
        actions = contract.random_actions(env, generator)
        pushed = (actions[:, 0] < 5) & (actions[:, 0] > 0)
        world = env.step(arrdict.arrdict(actions=actions))
        now, reset = env.core.agents.positions.clone(), world.reset.cpu()
        moved = (now - before).square().sum(-1).sqrt()[:, 0].cpu()
        stopped = (env.core.agents.velocity[:, 0] == 0).all(-1) & pushed
        walked, hits = (
            torch.where(reset, 0.0, total + more)
            for total, more in ((walked, moved), (hits, stopped.cpu()))
        )
        before = now
        torch.testing.assert_close(env.progress[5].cpu(), walked, rtol=1e-4, atol=1e-5)
        collisions = env.progress[6].cpu()
        assert (collisions >= hits).all(), "at rest beside a wall an idle step is none"
        ends = (world.terminal | world.truncated).cpu()
        assert torch.equal(world.metrics.collisions.cpu(), torch.where(ends, collisions, 0.0))
        n_ends += int(ends.sum())
    assert n_ends > 20 and hits.sum() > 0


def test_the_goal_is_told_in_the_agents_frame_at_each_step(device):
    env = made(device, 16, sample("homes", 2), resample=True)
    world = env.reset()
    generator = torch.Generator().manual_seed(1)
    for _ in range(20):
        goals = env.goals.points[env.layout.long(), env.goal_index.long()]
        across = (goals - env.core.agents.positions[:, 0]).cpu().double()
        radians = torch.deg2rad(env.core.agents.angles[:, 0].cpu().double())
        bearing = torch.atan2(across[:, 1], across[:, 0]) - radians
        expected = torch.stack([across.norm(dim=1) / 10, bearing.cos(), bearing.sin()], 1)
        torch.testing.assert_close(
            world.obs.goal[:, 0].cpu().double(), expected, rtol=2e-3, atol=2e-3
        )
        world = env.step(arrdict.arrdict(actions=contract.random_actions(env, generator)))


def test_a_critic_is_told_the_shortest_way_and_where_it_falls(device):
    """A small step along the gradient makes the way shorter by about as much."""
    env = made(device, 64, sample("homes", 4), privileged=True, resample=True)
    world = env.reset()
    told = world.privileged.way[:, 0].cpu()
    torch.testing.assert_close(told[:, 0] * 10, env.progress[2].cpu())
    assert (told[:, 3] == 1).all()
    slope = told[:, 1:3].norm(dim=1)
    assert ((slope > 0.6) & (slope < 1.6)).float().mean() > 0.9
    angles = torch.deg2rad(env.core.agents.angles[:, 0].cpu())
    ahead = torch.stack([angles.cos(), angles.sin()], 1)
    left = torch.stack([-angles.sin(), angles.cos()], 1)
    way = (told[:, 1:2] * ahead + told[:, 2:3] * left) / slope[:, None]
    before = env.progress[2].clone()
    env.core.agents.positions[:, 0] += 0.02 * way.to(device)
    env.core.agents.velocity.zero_()
    env.step(decided(env, 0))
    fell = (before - env.progress[2]).cpu() / 0.02
    assert torch.allclose(fell, slope, atol=0.35, rtol=0.1) or (fell > 0.5).float().mean() > 0.9


def test_where_no_way_is_known_the_distance_stays_as_it_was():
    env = made()
    env.reset()
    before = env.progress[2].clone()
    env.goals._tensors["fields"].fill_(torch.inf)
    world = env.step(decided(env, 0))
    assert torch.equal(env.progress[2], before)
    torch.testing.assert_close(world.reward, torch.full((4,), -0.02))


@pytest.mark.parametrize(
    "settings, words",
    [
        (dict(nearest=30.0, furthest=40.0), "geometry 7 has no goal from 30 to 40 m"),
        (dict(nearest=5.0, furthest=2.0), "0 <= nearest < furthest"),
        (dict(limit=0), "limit"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        made(**settings)
