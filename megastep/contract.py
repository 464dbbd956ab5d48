"""Checks that an environment keeps the contract between environments and learners.

``contract.rollout(env, 60)`` steps an environment with random actions and raises ContractError at
the first world that breaks a clause. Axes: N environments, A agents, B = N A lanes.
"""

import numbers
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.engine.state_tree import restore, snapshot
from megastep.types import Env, Space, Tree, World, n_lanes, optional, takes_masks

__all__ = [
    "ATTRIBUTES",
    "ContractError",
    "check_environment",
    "check_resets",
    "check_world",
    "random_actions",
    "rollout",
    "same",
]

FLAGS = "reset", "terminal", "truncated"
FLOATS = torch.float16, torch.float32  # of an observation whose space names no dtype
INTEGERS = tuple(
    getattr(torch, f"{sign}int{bits}") for sign in ("", "u") for bits in (8, 16, 32, 64)
)
RESERVED = "count", "window", "return", "length", "return_std"  # reported of every episode
#: Required attributes of an environment, and what each is.
ATTRIBUTES = {
    "n_envs": "the number of environments, N",
    "device": "the device that the tensors are on",
    "obs_space": "the space, or dict of spaces, of one lane's observation",
    "action_space": "the space, or dict of spaces, of one lane's actions",
    "reset": "a method that starts every episode and returns a world",
    "step": "a method that takes a decision and returns a world",
}


class ContractError(AssertionError):
    """An environment breaks a clause of the contract. The message names class and clause."""


def _require(env: Env, holds: bool, clause: str) -> None:
    if not holds:
        raise ContractError(f"{type(env).__name__} breaks the contract: {clause}")


# ---- The environment ----


def check_environment(env: Env) -> None:
    """Checks the attributes of an environment, the required and the optional ones.

    Raises:
        ContractError: if one is missing or wrong.
    """
    for name, meaning in ATTRIBUTES.items():
        _require(env, hasattr(env, name), f"it has no {name}: {meaning}")
    for path, space in spaces.leaves(env.action_space, "action_space").items():
        _require(
            env,
            isinstance(space, (spaces.MultiDiscrete, spaces.MultiContinuous)),
            f"{path} must be MultiDiscrete, MultiContinuous or a dict of them, not {space!r}",
        )
    names = "n_agents", "fps", "check", "layout", "roles"
    n_agents, fps, check, layout, roles = (optional(env, name) for name in names)
    is_count = isinstance(n_agents, numbers.Integral) and int(n_agents) > 0
    _require(env, is_count, f"n_agents must be a positive integer, not {n_agents!r}")
    is_rate = isinstance(fps, numbers.Real) and float(fps) > 0
    _require(env, is_rate, f"fps must be a positive number, not {fps!r}")
    _require(env, callable(check), f"check must be a method without arguments, not {check!r}")
    check()
    _require(
        env,
        layout is None or (layout.shape == (env.n_envs,) and not layout.is_floating_point()),
        f"layout must hold one integer per environment, shape ({env.n_envs},)",
    )
    is_list = isinstance(roles, (tuple, list)) and len(roles) == n_agents
    _require(
        env,
        roles is None or is_list,
        f"roles must hold one name per agent, {n_agents} in all, not {roles!r}",
    )
    _require(
        env,
        roles is None or _are_names(roles),
        f"roles must be identifiers, such as red_team, as metrics have them in their names, not "
        f"{roles!r}",
    )


def _are_names(words) -> bool:
    return all(isinstance(word, str) and word.isidentifier() for word in words)


# ---- A world ----


def check_world(env: Env, world: World, last: World | None = None) -> None:
    """Checks one world against the contract.

    Args:
        env: the environment that returned it.
        world: the world to check.
        last: the world one step earlier; None if ``world`` came from ``reset``.

    Raises:
        ContractError: if the world breaks a clause.
    """
    kind = type(world).__name__
    _require(env, isinstance(world, arrdict), f"a world must be a megastep.arrdict, not a {kind}")
    for key in ("obs", "reward", *FLAGS):
        _require(env, key in world, f"the world has no {key}")
    _check_per_lane(env, "reward", world["reward"], torch.float32)
    for key in FLAGS:
        _check_per_lane(env, key, world[key], torch.bool)
    for path, space, values in _leaves(env, env.obs_space, world["obs"], "obs"):
        _check_observation(env, path, space, values)
    _check_privileged(env, world)
    _check_episodes(env, world, last)
    _check_metrics(env, world, last)
    _check_game_over(env, world)
    _require(
        env,
        last is None or ("learns" in world) == ("learns" in last),
        "learns must be in every world or in none",
    )
    if "learns" in world:
        _check_per_lane(env, "learns", world["learns"], torch.bool)


def _check_tensor(env, path, values, shape, dtypes, kind=None) -> None:
    """Requires a tensor of this shape, of one of the dtypes, on the environment's device."""
    described = repr(values)
    if isinstance(values, torch.Tensor):
        described = f"{values.dtype} {tuple(values.shape)} on {values.device.type}"
    device = torch.device(env.device).type
    kind = kind or " or ".join(str(dtype) for dtype in dtypes)
    _require(
        env,
        isinstance(values, torch.Tensor)
        and values.shape == shape
        and values.dtype in dtypes
        and values.device.type == device,
        f"{path} must be {kind} {tuple(shape)} on {device}, not {described}",
    )


def _check_per_lane(env, path, values, dtype) -> None:
    _check_tensor(env, path, values, (n_lanes(env),), (dtype,))


def _leaves(env: Env, space: Space, values: Tree, name: str) -> Iterator[tuple[str, Space, Any]]:
    """Yields (path, leaf space, leaf value). The values must have the keys of the space."""
    expected, present = spaces.leaves(space, name), spaces.leaves(values, name)
    _require(
        env,
        expected.keys() == present.keys(),
        f"the world must have {', '.join(expected)}, as {name}_space has, not {', '.join(present)}",
    )
    for path, leaf in expected.items():
        yield path, leaf, present[path]


def _check_observation(env, path, space, values) -> None:
    shape = n_lanes(env), *space.shape
    if isinstance(space, spaces.MultiDiscrete):
        _check_tensor(env, path, values, shape, INTEGERS, "integers")
        inside = bool(((values >= 0) & (values < space.n_actions)).all())
        _require(env, inside, f"{path} must be from 0 to {space.n_actions - 1}")
        return
    dtype = getattr(space, "dtype", None)
    _check_tensor(env, path, values, shape, (dtype,) if dtype else FLOATS)
    _require(env, bool(values.isfinite().all()), f"{path} must be finite")
    if getattr(space, "low", None) is not None or getattr(space, "high", None) is not None:
        low, high = space.bounds(values.device)
        inside = (values >= low) & (values <= high)
        outside = values[~inside].float().tolist()[:1]
        _require(
            env, not outside, f"{path} must be within {space.low} and {space.high}, not {outside}"
        )


def _check_privileged(env, world) -> None:
    space = optional(env, "privileged_space")
    has_values, has_space = "privileged" in world, space is not None
    _require(
        env,
        has_values == has_space,
        "privileged must be in the world if, and only if, privileged_space is not None",
    )
    if space is None:
        return
    for path, leaf, values in _leaves(env, space, world["privileged"], "privileged"):
        shape = n_lanes(env), *leaf.shape
        _check_tensor(env, path, values, shape, (torch.float32,))
        _require(env, bool(values.isfinite().all()), f"{path} must be finite")


def _check_episodes(env, world, last) -> None:
    """Requires finite rewards, and flags that agree with those of the last step."""
    reward, (reset, terminal, truncated) = world["reward"], (world[key] for key in FLAGS)
    _require(env, bool(reward.isfinite().all()), "reward must be finite")
    both, ended = terminal & truncated, terminal | truncated
    _require(env, not bool(both.any()), "terminal and truncated exclude each other")
    _require(
        env,
        not bool((reset & ended).any()),
        "an episode must not end at its first observation: where reset is True, terminal and "
        "truncated are False",
    )
    _require(
        env,
        not bool(reward[reset].any()),
        "reward must be 0 at the first observation of an episode",
    )
    expected = torch.ones_like(reset) if last is None else last["terminal"] | last["truncated"]
    learned = True if last is None else last.get("learns", True)
    _require(
        env,
        torch.equal(reset & (expected | learned), expected),
        "reset must be True after env.reset() and in the step after an episode ended, and False "
        "otherwise, but may be True in lanes whose learns was False",
    )


def _check_metrics(env, world, last) -> None:
    metrics = world.get("metrics", {})
    _require(env, isinstance(metrics, Mapping), "metrics must be a dict of tensors")
    _require(
        env,
        last is None or metrics.keys() == last.get("metrics", {}).keys(),
        "metrics must have the same keys in every world",
    )
    for name, values in metrics.items():
        _require(
            env,
            _are_names([name]) and name not in RESERVED,
            f"the name of a metric must be an identifier other than {', '.join(RESERVED)}, "
            f"not {name!r}",
        )
        _check_per_lane(env, f"metrics.{name}", values, torch.float32)


def _check_game_over(env, world) -> None:
    over = optional(env, "game_over")
    if over is None:
        return
    _check_tensor(env, "game_over", over, (env.n_envs,), (torch.bool,))
    ended = (world["terminal"] | world["truncated"]).view(env.n_envs, -1).all(1)
    _require(
        env,
        not bool((over & ~ended).any()),
        "where game_over is True, every lane must be terminal or truncated",
    )


# ---- Stepping ----


def check_resets(env: Env) -> None:
    """Checks ``reset(seed, mask)`` of an environment that :func:`~megastep.types.takes_masks`.
    Leaves its tensors as they were.

    Raises:
        ContractError: if a masked reset changes other lanes or begins no episode in its own, or one
            seed gives two first worlds.
    """
    n, n_agents, before = n_lanes(env), optional(env, "n_agents"), snapshot(env)
    reset: Callable = env.reset
    first = reset(seed=1).clone()
    check_world(env, first)
    decision = arrdict(actions=random_actions(env, torch.Generator().manual_seed(1)))
    last = env.step(decision).clone()
    mask = torch.arange(n, device=env.device) // n_agents % 2 == 0  # every other environment
    world = reset(seed=torch.ones(n, dtype=torch.int64, device=env.device), mask=mask)
    _require(
        env, bool(world["reset"][mask].all()), "reset must be True in the lanes of a masked reset"
    )
    for path, leaf in spaces.leaves(world).items():
        was, begins = spaces.leaves(last)[path], spaces.leaves(first)[path]
        _require(
            env,
            torch.equal(leaf[~mask], was[~mask]),
            f"a masked reset must leave other lanes as they are, but {path} has changed",
        )
        _require(
            env,
            torch.equal(leaf[mask], begins[mask]) or not path.startswith("obs"),
            f"a seed must give the same first world each time, but {path} differs",
        )
    restore(env, before)


def random_actions(env: Env, generator: torch.Generator) -> Tree:
    """Returns uniformly random actions, (B, ...) per leaf of the action space, on the environment's
    device. ``generator`` is a CPU generator, so the actions are the same on every device.
    """

    def draw(space) -> torch.Tensor:
        return spaces.random_actions(space, n_lanes(env), generator=generator).to(env.device)

    return spaces.map(draw, env.action_space)


def rollout(env: Env, n_steps: int, seed: int = 1, check: bool = True) -> list[arrdict]:
    """Resets an environment and takes random steps. Returns copies of the ``n_steps`` + 1 worlds.

    Args:
        env: the environment.
        n_steps: number of steps after the reset.
        seed: of the random actions.
        check: check the environment and every world against the contract.

    Raises:
        ContractError: if a checked world breaks a clause.
    """
    if check:
        check_environment(env)
        if takes_masks(env):
            check_resets(env)
    generator, worlds = torch.Generator().manual_seed(seed), []

    def add(world) -> None:
        if check:
            check_world(env, world, worlds[-1] if worlds else None)
        worlds.append(world.clone())

    add(env.reset())
    for _ in range(n_steps):
        add(env.step(arrdict(actions=random_actions(env, generator))))
    if check:
        optional(env, "check")()
    return worlds


def same(a: Tree, b: Tree) -> bool:
    """Returns True if two trees of tensors have the same keys and equal bits."""
    a, b = spaces.leaves(a), spaces.leaves(b)
    return a.keys() == b.keys() and all(torch.equal(a[path].cpu(), b[path].cpu()) for path in a)
