"""The world contract as a checker: what every environment must keep, clause by clause."""

import torch

from megastep.arrdict import arrdict
from megastep.dotdict import dotdict

FLAGS = "reset", "terminal", "truncated"


def spaces_of(tree):
    return list(tree.items()) if isinstance(tree, dotdict) else [(None, tree)]


def random_actions(env, generator):
    """Uniform actions (B, n) for an environment, drawn on the CPU."""

    def draw(space):
        lanes = env.n_envs * env.n_agents
        return torch.randint(space.n_actions, (lanes, *space.shape), generator=generator).to(
            env.device
        )

    actions = {key: draw(space) for key, space in spaces_of(env.action_space)}
    return actions[None] if None in actions else arrdict(actions)


def check_world(env, world, last=None):
    """One world against the contract; ``last`` is the world before it, None after a reset."""
    lanes = env.n_envs * env.n_agents
    device = torch.device(env.device)
    for key in ("reward", *FLAGS):
        assert world[key].shape == (lanes,), f"{key} has one value a lane"
        assert world[key].device.type == device.type, f"{key} is on the environment's device"
    assert world.reward.dtype == torch.float32, "rewards are float32"
    assert all(world[key].dtype == torch.bool for key in FLAGS), "flags are bools"
    for key, space in spaces_of(env.obs_space):
        obs = world.obs if key is None else world.obs[key]
        assert obs.shape == (lanes, *space.shape), f"observation {key} is as its space says"
        assert obs.device.type == device.type and obs.dtype in (torch.float16, torch.float32), (
            f"observation {key} is a float on the device"
        )
        assert bool(obs.isfinite().all()), f"observation {key} is finite"
    assert bool(world.reward.isfinite().all()), "rewards are finite"
    assert not bool((world.terminal & world.truncated).any()), (
        "terminal and truncated exclude each other"
    )
    assert not bool((world.reset & (world.terminal | world.truncated)).any()), (
        "an episode does not end at its first observation"
    )
    assert not bool(world.reward[world.reset].any()), (
        "the first observation of an episode pays nothing"
    )
    began = torch.ones_like(world.reset) if last is None else last.terminal | last.truncated
    assert torch.equal(world.reset, began), "reset follows the end of an episode, and nothing else"


def rollout(env, n_steps, seed=1, check=True):
    """Worlds of ``n_steps`` random steps after a reset, cloned."""
    generator = torch.Generator().manual_seed(seed)
    worlds = [env.reset().clone()]
    check and check_world(env, worlds[0])
    for _ in range(n_steps):
        worlds.append(env.step(arrdict(actions=random_actions(env, generator))).clone())
        check and check_world(env, worlds[-1], worlds[-2])
    return worlds


def same(a, b):
    """Are two trees of tensors equal bit by bit?"""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return torch.equal(a.cpu(), b.cpu())
