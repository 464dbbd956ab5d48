"""The contract of environments as a checker: what every world must keep, clause by clause.

``contract.rollout(env, 60)`` steps an environment with random actions and raises ContractError,
naming its class and the clause, at the first world that breaks one. B lanes, N environments.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import torch

from megastep.arrdict import arrdict
from megastep.spaces import MultiDiscrete

__all__ = [
    "ATTRIBUTES",
    "ContractError",
    "check_environment",
    "check_world",
    "random_actions",
    "rollout",
    "same",
]

FLAGS = "reset", "terminal", "truncated"
ROOTS = "observation", "privileged"  # what trees of spaces are called, before their keys
RESERVED = "count", "return", "length", "return_std"  # of every episode, beside its metrics
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


class ContractError(AssertionError):
    """An environment breaks a clause of the contract. The message names its class and the
    clause.
    """


def _require(env: Any, kept: bool, clause: str) -> None:
    if not kept:
        raise ContractError(f"{type(env).__name__} breaks the contract: {clause}")


def _leaves(env: Any, space: Any, values: Any, name: str) -> Iterator[tuple[str, Any, Any]]:
    """(name, space, values) for every leaf of a tree of spaces; values are None where absent."""
    if not isinstance(space, Mapping):
        yield name, space, values
        return
    extra = [key for key in values if key not in space] if isinstance(values, Mapping) else []
    _require(env, not extra, f"{name} has the keys of its space, and not {extra[:1]}")
    for key, child in space.items():
        inner = values.get(key) if isinstance(values, Mapping) else None
        yield from _leaves(env, child, inner, f"{name}{' ' if name in ROOTS else '.'}{key}")


def check_environment(env: Any) -> None:
    """What an environment must have beside its worlds, and ``layout`` and ``roles`` if it has
    them.
    """
    for name, meaning in ATTRIBUTES.items():
        _require(env, hasattr(env, name), f"it has no {name}: {meaning}")
    _require(env, env.fps > 0, f"fps is a positive number of steps per second, not {env.fps}")
    env.check()
    layout = getattr(env, "layout", None)
    _require(
        env,
        layout is None or (layout.shape == (env.n_envs,) and not layout.is_floating_point()),
        "layout has one integer per environment",
    )
    roles = getattr(env, "roles", None)
    _require(
        env,
        roles is None
        or (isinstance(roles, (tuple, list)) and len(roles) == env.n_agents and _are_names(roles)),
        f"roles has one name per agent of an environment, {env.n_agents} in all, not {roles!r}",
    )


def _are_names(words):
    return all(isinstance(word, str) and word.isidentifier() for word in words)


def check_world(env: Any, world: Mapping, last: Mapping | None = None) -> None:
    """One world against the contract; ``last`` is the world before it, None after a reset."""
    for key in ("obs", "reward", *FLAGS):
        _require(env, key in world, f"a world has {key}")
    for key in ("reward", *FLAGS):
        _require(env, _has_lanes(env, world[key]), f"{key} has one value per lane")
        _require(env, _is_there(env, world[key]), f"{key} is on the environment's device")
    _require(env, world["reward"].dtype == torch.float32, "rewards are float32")
    _require(env, all(world[key].dtype == torch.bool for key in FLAGS), "flags are bools")
    for name, space, values in _leaves(env, env.obs_space, world["obs"], "observation"):
        _check_observation(env, name, space, values)
    _check_privileged(env, world)
    _check_flow(env, world, last)
    _check_metrics(env, world, last)
    _require(
        env,
        last is None or ("learns" in world) == ("learns" in last),
        "every world has learns, or none has",
    )
    _require(
        env,
        "learns" not in world or _is_per_lane(env, world["learns"], torch.bool),
        "learns has one bool per lane, on the environment's device",
    )


def _has_lanes(env, values):
    return isinstance(values, torch.Tensor) and values.shape == (env.n_envs * env.n_agents,)


def _is_there(env, values):
    return values.device.type == torch.device(env.device).type


def _is_per_lane(env, values, dtype):
    return _has_lanes(env, values) and values.dtype == dtype and _is_there(env, values)


def _check_observation(env, name, space, values):
    shape = env.n_envs * env.n_agents, *space.shape
    _require(
        env,
        isinstance(values, torch.Tensor) and values.shape == shape,
        f"{name} is as its space says",
    )
    dtype, there = getattr(space, "dtype", None), _is_there(env, values)
    if isinstance(space, MultiDiscrete):
        is_integer = not (values.is_floating_point() or values.dtype == torch.bool)
        _require(env, there and is_integer, f"{name} is integers on the device")
        inside = bool(((values >= 0) & (values < space.n_actions)).all())
        _require(env, inside, f"{name} is from 0 to {space.n_actions - 1}")
        return
    dtypes = (dtype,) if dtype else (torch.float16, torch.float32)
    kind = f"of the {dtype} that its space names, and" if dtype else "a float"
    _require(env, there and values.dtype in dtypes, f"{name} is {kind} on the device")
    _require(env, bool(values.isfinite().all()), f"{name} is finite")


def _check_privileged(env, world):
    space = getattr(env, "privileged_space", None)
    _require(
        env,
        ("privileged" in world) == (space is not None),
        "a world has privileged values if, and only if, there is a privileged_space",
    )
    if space is None:
        return
    lanes = env.n_envs * env.n_agents
    root = "privileged" if isinstance(space, Mapping) else "privileged values"
    for name, leaf, values in _leaves(env, space, world["privileged"], root):
        _require(
            env,
            isinstance(values, torch.Tensor) and values.shape == (lanes, *leaf.shape),
            f"{name} are as their space says",
        )
        _require(
            env,
            _is_there(env, values) and values.dtype == torch.float32,
            f"{name} are float32 on the device",
        )
        _require(env, bool(values.isfinite().all()), f"{name} are finite")


def _check_flow(env, world, last):
    """Rewards, and how episodes follow each other."""
    reward, (reset, terminal, truncated) = world["reward"], (world[key] for key in FLAGS)
    _require(env, bool(reward.isfinite().all()), "rewards are finite")
    both, ends = terminal & truncated, terminal | truncated
    _require(env, not bool(both.any()), "terminal and truncated exclude each other")
    _require(
        env, not bool((reset & ends).any()), "an episode does not end at its first observation"
    )
    _require(env, not bool(reward[reset].any()), "the first observation of an episode pays nothing")
    began = torch.ones_like(reset) if last is None else last["terminal"] | last["truncated"]
    _require(
        env, torch.equal(reset, began), "reset follows the end of an episode, and nothing else"
    )


def _check_metrics(env, world, last):
    metrics = world.get("metrics", {})
    _require(env, isinstance(metrics, Mapping), "metrics is a dict of tensors")
    _require(
        env,
        last is None or metrics.keys() == last.get("metrics", {}).keys(),
        "every world has the same metrics",
    )
    ends = world["terminal"] | world["truncated"]
    for name, values in metrics.items():
        _require(
            env,
            _are_names([name]) and name not in RESERVED,
            f"a metric is called by a name other than {', '.join(RESERVED)}, not {name!r}",
        )
        given = (
            f"{values.dtype} {tuple(values.shape)}"
            if isinstance(values, torch.Tensor)
            else repr(values)
        )
        _require(
            env,
            _is_per_lane(env, values, torch.float32),
            f"metric {name} has one float32 per lane, ({env.n_envs * env.n_agents},), on the "
            f"environment's device, not {given}",
        )
        _require(
            env, bool(values[ends].isfinite().all()), f"metric {name} is finite where episodes end"
        )


def random_actions(env: Any, generator: torch.Generator) -> Any:
    """Uniform actions (B, n) for an environment, drawn on the CPU by a CPU generator."""

    def draw(space):
        if isinstance(space, Mapping):
            return arrdict({key: draw(child) for key, child in space.items()})
        lanes = env.n_envs * env.n_agents
        actions = torch.randint(space.n_actions, (lanes, *space.shape), generator=generator)
        return actions.to(env.device)

    return draw(env.action_space)


def rollout(env: Any, n_steps: int, seed: int = 1, check: bool = True) -> list[arrdict]:
    """The worlds of a reset and ``n_steps`` random steps, copied; each is checked if ``check``."""
    if check:
        check_environment(env)
    generator, worlds = torch.Generator().manual_seed(seed), []

    def add(world):
        if check:
            check_world(env, world, worlds[-1] if worlds else None)
        worlds.append(world.clone())

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
