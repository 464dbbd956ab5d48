"""Checks that an environment keeps the contract between environments and learners.

``contract.rollout(env, 60)`` steps an environment with random actions and raises ContractError at
the first world that breaks a clause. Axes: N environments, A agents, B = N A lanes.
"""

import numbers
from collections.abc import Callable, Mapping
from typing import cast

import torch

from megastep import spaces
from megastep.arrdict import arrdict
from megastep.engine.state_tree import restore, snapshot
from megastep.types import Env, Tree, World, n_lanes, optional, takes_masks

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


def _require(env, holds, clause) -> None:
    if not holds:
        raise ContractError(f"{type(env).__name__} breaks the contract: {clause}")


def check_environment(env: Env) -> None:
    """Checks the required and the optional attributes of an environment. Raises ContractError."""
    for name, meaning in ATTRIBUTES.items():
        _require(env, hasattr(env, name), f"it has no {name}: {meaning}")
    for path, space in spaces.leaves(env.action_space, "action_space").items():
        is_action = isinstance(space, (spaces.MultiDiscrete, spaces.MultiContinuous))
        must = f"{path} must be MultiDiscrete, MultiContinuous or a dict of them"
        _require(env, is_action, f"{must}, not {space!r}")
    names = "n_agents", "fps", "check", "layout", "roles"
    n_agents, fps, check, layout, roles = (optional(env, name) for name in names)
    is_positive = isinstance(n_agents, numbers.Integral) and int(n_agents) > 0
    _require(env, is_positive, f"n_agents must be a positive integer, not {n_agents!r}")
    is_positive = isinstance(fps, numbers.Real) and float(fps) > 0
    _require(env, is_positive, f"fps must be a positive number, not {fps!r}")
    _require(env, callable(check), f"check must be a method without arguments, not {check!r}")
    check()
    if layout is not None:
        is_alike = layout.shape == (env.n_envs,) and not layout.is_floating_point()
        must = "layout must hold one integer per environment"
        _require(env, is_alike, f"{must}, shape ({env.n_envs},)")
    if roles is not None:
        is_alike = isinstance(roles, (tuple, list)) and len(roles) == n_agents
        must = f"roles must hold one name per agent, {n_agents} in all"
        _require(env, is_alike, f"{must}, not {roles!r}")
        must = "roles must be identifiers, such as red_team, as metrics have them in their names"
        _require(env, all(map(_is_name, roles)), f"{must}, not {roles!r}")


def _is_name(word) -> bool:
    return isinstance(word, str) and word.isidentifier()


# ---- A world ----


def check_world(env: Env, world: World, last: World | None = None) -> None:
    """Checks a world of an environment. Raises ContractError if it breaks a clause.

    Args:
        last: the world one step earlier; None if ``world`` came from ``reset``.
    """
    is_arrdict = isinstance(world, arrdict)
    _require(env, is_arrdict, f"a world must be a megastep.arrdict, not a {type(world).__name__}")
    for key in ("obs", "reward", *FLAGS):
        _require(env, key in world, f"the world has no {key}")
    lanes = (n_lanes(env),)
    _check_tensor(env, "reward", world["reward"], lanes, (torch.float32,))
    for key in FLAGS:
        _check_tensor(env, key, world[key], lanes, (torch.bool,))
    _check_observation(env, "obs", env.obs_space, world)
    privileged = optional(env, "privileged_space")
    clause = "privileged must be in the world if, and only if, privileged_space is not None"
    _require(env, ("privileged" in world) == (privileged is not None), clause)
    if privileged is not None:
        _check_observation(env, "privileged", privileged, world)
    _check_episodes(env, world, last)
    _check_metrics(env, world, last)
    for key in ("learns", "mask"):
        is_same = last is None or (key in world) == (key in last)
        _require(env, is_same, f"{key} must be in every world or in none")
    if "learns" in world:
        _check_tensor(env, "learns", world["learns"], lanes, (torch.bool,))
    if "mask" in world:
        _check_mask(env, world["mask"])


def _check_tensor(env, path, values, shape, dtypes, kind=None) -> None:
    """Requires a tensor of this shape, of one of the dtypes, on the environment's device."""
    device, is_alike = torch.device(env.device).type, False
    if isinstance(values, torch.Tensor):
        described = f"{values.dtype} {tuple(values.shape)} on {values.device.type}"
        is_alike = values.shape == shape and values.dtype in dtypes
        is_alike = is_alike and values.device.type == device
    else:
        described = repr(values)
    kind = kind or " or ".join(map(str, dtypes))
    _require(env, is_alike, f"{path} must be {kind} {tuple(shape)} on {device}, not {described}")


def _check_observation(env, name, space, world) -> None:
    expected, present = spaces.leaves(space, name), spaces.leaves(world[name], name)
    must = f"the world must have {', '.join(expected)}, as {name}_space has"
    _require(env, expected.keys() == present.keys(), f"{must}, not {', '.join(present)}")
    for path, leaf in expected.items():
        shape, values = (n_lanes(env), *leaf.shape), present[path]
        if isinstance(leaf, spaces.MultiDiscrete):
            _check_tensor(env, path, values, shape, INTEGERS, "integers")
            is_inside = bool(((values >= 0) & (values < leaf.n_actions)).all())
            _require(env, is_inside, f"{path} must be from 0 to {leaf.n_actions - 1}")
            continue
        dtypes = (leaf.dtype,) if getattr(leaf, "dtype", None) else FLOATS
        dtypes = dtypes if name == "obs" else (torch.float32,)
        _check_tensor(env, path, values, shape, dtypes)
        _require(env, bool(values.isfinite().all()), f"{path} must be finite")
        if getattr(leaf, "low", None) is not None or getattr(leaf, "high", None) is not None:
            low, high = leaf.bounds(values.device)
            outside = values[(values < low) | (values > high)].float().tolist()[:1]
            must = f"{path} must be within {leaf.low} and {leaf.high}"
            _require(env, not outside, f"{must}, not {outside}")


def _check_mask(env, mask) -> None:
    """Requires a bool per action of discrete spaces, of which at least one is true."""
    actions = spaces.leaves(env.action_space, "mask")
    for path, values in spaces.leaves(mask, "mask").items():
        space: Tree = actions.get(path)
        is_discrete = isinstance(space, spaces.MultiDiscrete)
        _require(env, is_discrete, f"{path} is of no discrete action space: leave it out")
        shape = n_lanes(env), *space.shape, space.n_actions
        _check_tensor(env, path, values, shape, (torch.bool,))
        _require(env, bool(values.any(-1).all()), f"{path} must allow at least one action")


def _check_episodes(env, world, last) -> None:
    """Requires finite rewards, and flags that agree with those of the last step."""
    reward, (reset, terminal, truncated) = world["reward"], (world[key] for key in FLAGS)
    ended = terminal | truncated
    expected = torch.ones_like(reset) if last is None else last["terminal"] | last["truncated"]
    learned = True if last is None else last.get("learns", True)
    for holds, clause in (
        (reward.isfinite().all(), "reward must be finite"),
        (~(terminal & truncated).any(), "terminal and truncated exclude each other"),
        (
            ~(reset & ended).any(),
            "an episode must not end at its first observation: where reset is True, terminal and "
            "truncated are False",
        ),
        (~reward[reset].any(), "reward must be 0 at the first observation of an episode"),
        (
            torch.equal(reset & (expected | learned), expected),
            "reset must be True after env.reset() and in the step after an episode ended, and "
            "False otherwise, but may be True in lanes whose learns was False",
        ),
    ):
        _require(env, bool(holds), clause)
    if (over := optional(env, "game_over")) is not None:
        _check_tensor(env, "game_over", over, (env.n_envs,), (torch.bool,))
        is_ended = not bool((over & ~ended.view(env.n_envs, -1).all(1)).any())
        _require(env, is_ended, "where game_over is True, every lane must be terminal or truncated")


def _check_metrics(env, world, last) -> None:
    metrics = world.get("metrics", {})
    _require(env, isinstance(metrics, Mapping), "metrics must be a dict of tensors")
    is_same = last is None or metrics.keys() == last.get("metrics", {}).keys()
    _require(env, is_same, "metrics must have the same keys in every world")
    for name, values in metrics.items():
        must = f"the name of a metric must be an identifier other than {', '.join(RESERVED)}"
        _require(env, _is_name(name) and name not in RESERVED, f"{must}, not {name!r}")
        _check_tensor(env, f"metrics.{name}", values, (n_lanes(env),), (torch.float32,))


# ---- Stepping ----


def check_resets(env: Env) -> None:
    """Checks ``reset(seed, mask)`` of an environment that :func:`~megastep.types.takes_masks`.
    Leaves its tensors as they were. Raises ContractError if a masked reset changes other lanes or
    begins no episode in its own, or one seed gives two first worlds.
    """
    before, n, reset = snapshot(env), n_lanes(env), cast(Callable, env.reset)
    first = reset(seed=1).clone()
    check_world(env, first)
    decision = arrdict(actions=random_actions(env, torch.Generator().manual_seed(1)))
    last = spaces.leaves(env.step(decision).clone())
    # every other environment
    mask = torch.arange(n, device=env.device) // optional(env, "n_agents") % 2 == 0
    world = reset(seed=torch.ones(n, dtype=torch.int64, device=env.device), mask=mask)
    begins = bool(world["reset"][mask].all())
    _require(env, begins, "reset must be True in the lanes of a masked reset")
    for path, leaf in spaces.leaves(world).items():
        clause = f"a masked reset must leave other lanes as they are, but {path} has changed"
        _require(env, torch.equal(leaf[~mask], last[path][~mask]), clause)
        if path.startswith("obs"):
            clause = f"a seed must give the same first world each time, but {path} differs"
            _require(env, torch.equal(leaf[mask], spaces.leaves(first)[path][mask]), clause)
    restore(env, before)


def random_actions(env: Env, generator: torch.Generator, mask: Tree = None) -> Tree:
    """Returns uniformly random actions, (B, ...) per leaf of the action space, on the environment's
    device. ``generator`` is a CPU generator, so the actions are the same on every device. ``mask``
    is a world's, or None.
    """
    actions = spaces.random_actions(env.action_space, n_lanes(env), generator=generator, mask=mask)
    return spaces.map(lambda _, leaf: leaf.to(env.device), env.action_space, actions)


def rollout(env: Env, n_steps: int, seed: int = 1, check: bool = True) -> list[arrdict]:
    """Resets an environment and takes ``n_steps`` random steps. Returns copies of the ``n_steps`` +
    1 worlds. With ``check``, raises ContractError if the environment or a world breaks a clause.
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
        actions = random_actions(env, generator, worlds[-1].get("mask"))
        add(env.step(arrdict(actions=actions)))
    if check:
        optional(env, "check")()
    return worlds


def same(a: Tree, b: Tree) -> bool:
    """Returns True if two trees of tensors have the same keys and equal bits."""
    a, b = spaces.leaves(a), spaces.leaves(b)
    return a.keys() == b.keys() and all(torch.equal(a[path].cpu(), b[path].cpu()) for path in a)
