"""The contract of environments as a checker: what every world must keep, clause by clause.

``contract.rollout(env, 60)`` steps an environment with random actions and raises AssertionError,
naming the clause, at the first world that breaks one. B lanes, N environments.
"""

from collections.abc import Mapping
from typing import Any

import torch

from .arrdict import arrdict

__all__ = ["ATTRIBUTES", "check_environment", "check_world", "random_actions", "rollout", "same"]

FLAGS = "reset", "terminal", "truncated"
ATTRIBUTES = {
    "n_envs": "the number of its environments, N",
    "n_agents": "the lanes of one environment, agents that are controlled independently",
    "device": "where its tensors are",
    "fps": "its steps per second, which videos are played at",
    "obs_space": "a space, or a dotdict of them, of one lane's observation",
    "action_space": "a space, or a dotdict of them, of one lane's actions",
    "reset": "a method that begins every episode and returns a world",
    "step": "a method that takes a decision and returns a world",
    "check": "a method that raises the errors that its engine has flagged on the device",
}


def _require(kept, clause):
    if not kept:
        raise AssertionError(clause)


def _spaces(tree):
    return list(tree.items()) if isinstance(tree, dict) else [(None, tree)]


def check_environment(env: Any) -> None:
    """What an environment must have beside its worlds, and ``layout`` and ``privileged_space`` if
    it has them.
    """
    for name, meaning in ATTRIBUTES.items():
        _require(hasattr(env, name), f"{type(env).__name__} has no {name}: {meaning}")
    _require(env.fps > 0, f"fps is a positive number of steps per second, not {env.fps}")
    env.check()
    layout = getattr(env, "layout", None)
    _require(
        layout is None or (layout.shape == (env.n_envs,) and not layout.is_floating_point()),
        "layout has one integer per environment",
    )


def check_world(env: Any, world: Mapping, last: Mapping | None = None) -> None:
    """One world against the contract; ``last`` is the world before it, None after a reset."""
    lanes, device = env.n_envs * env.n_agents, torch.device(env.device)
    for key in ("reward", *FLAGS):
        _require(world[key].shape == (lanes,), f"{key} has one value per lane")
        _require(world[key].device.type == device.type, f"{key} is on the environment's device")
    _require(world["reward"].dtype == torch.float32, "rewards are float32")
    _require(all(world[key].dtype == torch.bool for key in FLAGS), "flags are bools")
    for key, space in _spaces(env.obs_space):
        obs = world["obs"] if key is None else world["obs"][key]
        _require(obs.shape == (lanes, *space.shape), f"observation {key} is as its space says")
        _require(
            obs.device.type == device.type and obs.dtype in (torch.float16, torch.float32),
            f"observation {key} is a float on the device",
        )
        _require(bool(obs.isfinite().all()), f"observation {key} is finite")
    privileged_space = getattr(env, "privileged_space", None)
    _require(
        ("privileged" in world) == (privileged_space is not None),
        "a world has privileged values if, and only if, there is a privileged_space",
    )
    for key, space in [] if privileged_space is None else _spaces(privileged_space):
        values = world["privileged"] if key is None else world["privileged"][key]
        name = f"privileged {'values' if key is None else key}"
        _require(values.shape == (lanes, *space.shape), f"{name} are as their space says")
        _require(
            values.device.type == device.type and values.dtype == torch.float32,
            f"{name} are float32 on the device",
        )
        _require(bool(values.isfinite().all()), f"{name} are finite")
    _require(bool(world["reward"].isfinite().all()), "rewards are finite")
    reset, terminal, truncated = (world[key] for key in FLAGS)
    _require(not bool((terminal & truncated).any()), "terminal and truncated exclude each other")
    _require(
        not bool((reset & (terminal | truncated)).any()),
        "an episode does not end at its first observation",
    )
    _require(
        not bool(world["reward"][reset].any()), "the first observation of an episode pays nothing"
    )
    began = torch.ones_like(reset) if last is None else last["terminal"] | last["truncated"]
    _require(torch.equal(reset, began), "reset follows the end of an episode, and nothing else")


def random_actions(env: Any, generator: torch.Generator) -> Any:
    """Uniform actions (B, n) for an environment, drawn on the CPU by a CPU generator."""

    def draw(space):
        lanes = env.n_envs * env.n_agents
        actions = torch.randint(space.n_actions, (lanes, *space.shape), generator=generator)
        return actions.to(env.device)

    actions = {key: draw(space) for key, space in _spaces(env.action_space)}
    return actions[None] if None in actions else arrdict(actions)


def rollout(env: Any, n_steps: int, seed: int = 1, check: bool = True) -> list[arrdict]:
    """The worlds of a reset and ``n_steps`` random steps, copied; each is checked if ``check``."""
    if check:
        check_environment(env)
    generator, worlds = torch.Generator().manual_seed(seed), []

    def add(world):
        worlds.append(world.clone())
        if check:
            check_world(env, worlds[-1], worlds[-2] if len(worlds) > 1 else None)

    add(env.reset())
    for _ in range(n_steps):
        add(env.step(arrdict(actions=random_actions(env, generator))))
    if check:
        env.check()
    return worlds


def same(a: Any, b: Any) -> bool:
    """Are two trees of tensors equal bit by bit?"""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return torch.equal(a.cpu(), b.cpu())
