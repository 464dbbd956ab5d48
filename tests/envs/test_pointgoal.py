"""PointGoal's rules by hand: rewards, ends of episodes, metrics."""

import numpy as np
import torch
from test_geodesics import room

from megastep import arrdict, contract, envs
from megastep.geometries import sample

FORWARD = 3


def make_env(device="cpu", n_envs=4, geometries=None, **settings):
    geometries = [room(width=8.0)] if geometries is None else geometries
    return envs.PointGoal(n_envs, geometries, device=device, res=8, subsample=1, **settings)


def decision(env, action):
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


def test_reward_is_progress_minus_cost():
    """In an empty room. A push adds 0.5 m/s, so 5 cm per step."""
    env = make_env(cost=0.02)
    env.reset()
    place(env, 0.6)
    env.step(decision(env, 0))
    before = env.progress[2].clone()
    world = env.step(decision(env, FORWARD))
    torch.testing.assert_close(world.reward, before - env.progress[2] - 0.02)
    torch.testing.assert_close(world.reward + 0.02, torch.full((4,), 0.05), atol=0.01, rtol=0)
    away = env.step(decision(env, 4))  # back: at rest again, almost
    assert (away.reward.abs() < 0.03).all()


def test_walking_has_a_cost_per_metre():
    free, paid = make_env(), make_env(walk_cost=0.4)
    for env in (free, paid):
        env.reset()
    for _ in range(5):
        before = free.progress[5].clone()
        without, costly = (env.step(decision(env, FORWARD)).reward for env in (free, paid))
    walked = free.progress[5] - before
    assert (walked > 0).any()
    torch.testing.assert_close(without - costly, 0.4 * walked)


def test_success_ends_the_episode_with_a_bonus(device):
    env = make_env(device, bonus=7.0, cost=0.5)
    env.reset()
    place(env, 0.27)
    world = env.step(decision(env, FORWARD))
    assert not world.terminal.any(), "0.22 m"
    world = env.step(decision(env, FORWARD))
    assert world.terminal.all() and not world.truncated.any() and (world.metrics.success == 1).all()
    assert ((world.reward > 6.4) & (world.reward < 6.7)).all(), "and some centimetres"
    after = env.step(decision(env, FORWARD))
    assert after.reset.all() and not after.reward.any() and not after.terminal.any()
    assert not env.progress[5].any() and not env.progress[6].any()


def test_spl_by_hand(device):
    """The shortest path is 1 m. First 2 m are walked, then half a metre."""
    env = make_env(device)
    env.reset()
    for walked, spl in ((2.0, 0.5), (0.5, 1.0)):
        place(env, 0.23)
        env.progress[4].fill_(1.0)
        env.progress[5].fill_(walked - 0.05)
        world = env.step(decision(env, FORWARD))
        assert world.terminal.all()
        np.testing.assert_allclose(world.metrics.spl.cpu(), spl, rtol=1e-4)
        np.testing.assert_allclose(world.metrics.soft_spl.cpu(), spl, rtol=1e-4)
        env.step(decision(env, 0))


def test_metres_walked_and_collisions(device):
    """Random walks, summed from the positions. A step that a wall cuts short leaves no velocity."""
    env = make_env(device, 16, [room(width=1.2, height=1.2)], nearest=0.3, limit=40)
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


def test_goal_observation_is_in_the_agents_frame(device):
    env = make_env(device, 16, sample("homes", 2), resample=True)
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


def test_privileged_is_the_distance_and_its_slope(device):
    """A small step along the slope makes the path shorter by about as much."""
    env = make_env(device, 64, sample("homes", 4), privileged=True, resample=True)
    world = env.reset()
    way = world.privileged.way[:, 0].cpu()
    torch.testing.assert_close(way[:, 0] * 10, env.progress[2].cpu())
    assert (way[:, 3] == 1).all()
    slope = way[:, 1:3].norm(dim=1)
    assert ((slope > 0.6) & (slope < 1.6)).float().mean() > 0.9
    angles = torch.deg2rad(env.core.agents.angles[:, 0].cpu())
    ahead = torch.stack([angles.cos(), angles.sin()], 1)
    left = torch.stack([-angles.sin(), angles.cos()], 1)
    downhill = (way[:, 1:2] * ahead + way[:, 2:3] * left) / slope[:, None]
    before = env.progress[2].clone()
    env.core.agents.positions[:, 0] += 0.02 * downhill.to(device)
    env.core.agents.velocity.zero_()
    env.step(decision(env, 0))
    decrease = (before - env.progress[2]).cpu() / 0.02
    assert (
        torch.allclose(decrease, slope, atol=0.35, rtol=0.1)
        or (decrease > 0.5).float().mean() > 0.9
    )


def test_distance_is_kept_where_the_field_is_infinite():
    env = make_env()
    env.reset()
    before = env.progress[2].clone()
    env.goals.fields.fill_(torch.inf)
    world = env.step(decision(env, 0))
    assert torch.equal(env.progress[2], before)
    torch.testing.assert_close(world.reward, torch.full((4,), -0.02))
