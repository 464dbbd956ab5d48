"""Checks that an environment keeps the contract between environments and learners.

``contract.rollout(env, 60)`` steps an environment with random actions and raises ContractError at
the first world that breaks a clause. Axes: N environments, A agents, B = N A lanes.
"""

import numbers
from collections.abc import Iterator, Mapping

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


# ---- The environment ----


def check_environment(env: Env) -> None:
    """Checks the required and the optional attributes of an environment. Raises ContractError."""
    _raise_first(env, _problems_of_environment(env))


def _raise_first(env, problems) -> None:
    for problem in problems:
        raise ContractError(f"{type(env).__name__} breaks the contract: {problem}")


def _problems_of_environment(env) -> Iterator[str]:
    """Yields what is wrong, as clauses. Those after the first may not hold."""
    for name, meaning in ATTRIBUTES.items():
        if not hasattr(env, name):
            yield f"it has no {name}: {meaning}"
    for path, space in spaces.leaves(env.action_space, "action_space").items():
        if not isinstance(space, (spaces.MultiDiscrete, spaces.MultiContinuous)):
            yield f"{path} must be MultiDiscrete, MultiContinuous or a dict of them, not {space!r}"
    names = "n_agents", "fps", "check", "layout", "roles"
    n_agents, fps, check, layout, roles = (optional(env, name) for name in names)
    if not (isinstance(n_agents, numbers.Integral) and int(n_agents) > 0):
        yield f"n_agents must be a positive integer, not {n_agents!r}"
    if not (isinstance(fps, numbers.Real) and float(fps) > 0):
        yield f"fps must be a positive number, not {fps!r}"
    if not callable(check):
        yield f"check must be a method without arguments, not {check!r}"
    check()
    if layout is not None and (layout.shape != (env.n_envs,) or layout.is_floating_point()):
        yield f"layout must hold one integer per environment, shape ({env.n_envs},)"
    if roles is None:
        return
    if not isinstance(roles, (tuple, list)) or len(roles) != n_agents:
        yield f"roles must hold one name per agent, {n_agents} in all, not {roles!r}"
    if not all(map(_is_name, roles)):
        names = "such as red_team, as metrics have them in their names"
        yield f"roles must be identifiers, {names}, not {roles!r}"


def _is_name(word) -> bool:
    return isinstance(word, str) and word.isidentifier()


# ---- A world ----


def check_world(env: Env, world: World, last: World | None = None) -> None:
    """Checks a world of an environment. Raises ContractError if it breaks a clause.

    Args:
        last: the world one step earlier; None if ``world`` came from ``reset``.
    """
    _raise_first(env, _problems_of_world(env, world, last))


def _problems_of_world(env, world, last) -> Iterator[str]:
    if not isinstance(world, arrdict):
        yield f"a world must be a megastep.arrdict, not a {type(world).__name__}"
    for key in ("obs", "reward", *FLAGS):
        if key not in world:
            yield f"the world has no {key}"
    yield from _problems_per_lane(env, "reward", world["reward"], torch.float32)
    for key in FLAGS:
        yield from _problems_per_lane(env, key, world[key], torch.bool)
    yield from _problems_of_observation(env, "obs", env.obs_space, world)
    privileged = optional(env, "privileged_space")
    if ("privileged" in world) != (privileged is not None):
        yield "privileged must be in the world if, and only if, privileged_space is not None"
    if privileged is not None:
        yield from _problems_of_observation(env, "privileged", privileged, world)
    yield from _problems_of_episodes(env, world, last)
    yield from _problems_of_metrics(env, world, last)
    for key in ("learns", "mask"):
        if last is not None and (key in world) != (key in last):
            yield f"{key} must be in every world or in none"
    if "learns" in world:
        yield from _problems_per_lane(env, "learns", world["learns"], torch.bool)
    if "mask" in world:
        yield from _problems_of_mask(env, world["mask"])


def _problems_of_tensor(env, path, values, shape, dtypes, kind=None) -> Iterator[str]:
    """Requires a tensor of this shape, of one of the dtypes, on the environment's device."""
    described, device = repr(values), torch.device(env.device).type
    if isinstance(values, torch.Tensor):
        described = f"{values.dtype} {tuple(values.shape)} on {values.device.type}"
        is_alike = values.shape == shape and values.dtype in dtypes
        if is_alike and values.device.type == device:
            return
    kind = kind or " or ".join(str(dtype) for dtype in dtypes)
    yield f"{path} must be {kind} {tuple(shape)} on {device}, not {described}"


def _problems_per_lane(env, path, values, dtype) -> Iterator[str]:
    return _problems_of_tensor(env, path, values, (n_lanes(env),), (dtype,))


def _problems_of_observation(env, name, space, world) -> Iterator[str]:
    expected, present = spaces.leaves(space, name), spaces.leaves(world[name], name)
    if expected.keys() != present.keys():
        has = f"{', '.join(expected)}, as {name}_space has, not {', '.join(present)}"
        yield f"the world must have {has}"
    for path, leaf in expected.items():
        shape, values = (n_lanes(env), *leaf.shape), present[path]
        if isinstance(leaf, spaces.MultiDiscrete):
            yield from _problems_of_tensor(env, path, values, shape, INTEGERS, "integers")
            if not bool(((values >= 0) & (values < leaf.n_actions)).all()):
                yield f"{path} must be from 0 to {leaf.n_actions - 1}"
            continue
        dtypes = (leaf.dtype,) if getattr(leaf, "dtype", None) else FLOATS
        dtypes = dtypes if name == "obs" else (torch.float32,)
        yield from _problems_of_tensor(env, path, values, shape, dtypes)
        if not bool(values.isfinite().all()):
            yield f"{path} must be finite"
        if getattr(leaf, "low", None) is not None or getattr(leaf, "high", None) is not None:
            low, high = leaf.bounds(values.device)
            outside = values[(values < low) | (values > high)].float().tolist()[:1]
            if outside:
                yield f"{path} must be within {leaf.low} and {leaf.high}, not {outside}"


def _problems_of_mask(env, mask) -> Iterator[str]:
    """Requires a bool per action of discrete spaces, of which at least one is true."""
    actions = spaces.leaves(env.action_space, "mask")
    for path, values in spaces.leaves(mask, "mask").items():
        space = actions.get(path)
        if not isinstance(space, spaces.MultiDiscrete):
            yield f"{path} is of no discrete action space: leave it out"
            return
        shape = n_lanes(env), *space.shape, space.n_actions
        yield from _problems_of_tensor(env, path, values, shape, (torch.bool,))
        if not bool(values.any(-1).all()):
            yield f"{path} must allow at least one action"


def _problems_of_episodes(env, world, last) -> Iterator[str]:
    """Requires finite rewards, and flags that agree with those of the last step."""
    reward, (reset, terminal, truncated) = world["reward"], (world[key] for key in FLAGS)
    ended = terminal | truncated
    if not bool(reward.isfinite().all()):
        yield "reward must be finite"
    if bool((terminal & truncated).any()):
        yield "terminal and truncated exclude each other"
    if bool((reset & ended).any()):
        yield (
            "an episode must not end at its first observation: where reset is True, terminal and "
            "truncated are False"
        )
    if bool(reward[reset].any()):
        yield "reward must be 0 at the first observation of an episode"
    expected = torch.ones_like(reset) if last is None else last["terminal"] | last["truncated"]
    learned = True if last is None else last.get("learns", True)
    if not torch.equal(reset & (expected | learned), expected):
        yield (
            "reset must be True after env.reset() and in the step after an episode ended, and "
            "False otherwise, but may be True in lanes whose learns was False"
        )
    if (over := optional(env, "game_over")) is not None:
        yield from _problems_of_tensor(env, "game_over", over, (env.n_envs,), (torch.bool,))
        if bool((over & ~ended.view(env.n_envs, -1).all(1)).any()):
            yield "where game_over is True, every lane must be terminal or truncated"


def _problems_of_metrics(env, world, last) -> Iterator[str]:
    metrics = world.get("metrics", {})
    if not isinstance(metrics, Mapping):
        yield "metrics must be a dict of tensors"
    if last is not None and metrics.keys() != last.get("metrics", {}).keys():
        yield "metrics must have the same keys in every world"
    for name, values in metrics.items():
        if not _is_name(name) or name in RESERVED:
            words = ", ".join(RESERVED)
            yield f"the name of a metric must be an identifier other than {words}, not {name!r}"
        yield from _problems_per_lane(env, f"metrics.{name}", values, torch.float32)


# ---- Stepping ----


def check_resets(env: Env) -> None:
    """Checks ``reset(seed, mask)`` of an environment that :func:`~megastep.types.takes_masks`.
    Leaves its tensors as they were. Raises ContractError if a masked reset changes other lanes or
    begins no episode in its own, or one seed gives two first worlds.
    """
    before = snapshot(env)
    _raise_first(env, _problems_of_resets(env))
    restore(env, before)


def _problems_of_resets(env) -> Iterator[str]:
    n, reset = n_lanes(env), env.reset
    first = reset(seed=1).clone()
    yield from _problems_of_world(env, first, None)
    decision = arrdict(actions=random_actions(env, torch.Generator().manual_seed(1)))
    last = env.step(decision).clone()
    # every other environment
    mask = torch.arange(n, device=env.device) // optional(env, "n_agents") % 2 == 0
    world = reset(seed=torch.ones(n, dtype=torch.int64, device=env.device), mask=mask)
    if not bool(world["reset"][mask].all()):
        yield "reset must be True in the lanes of a masked reset"
    for path, leaf in spaces.leaves(world).items():
        was, begins = spaces.leaves(last)[path], spaces.leaves(first)[path]
        if not torch.equal(leaf[~mask], was[~mask]):
            yield f"a masked reset must leave other lanes as they are, but {path} has changed"
        if path.startswith("obs") and not torch.equal(leaf[mask], begins[mask]):
            yield f"a seed must give the same first world each time, but {path} differs"


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
