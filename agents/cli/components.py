"""The objects a run is made of, from its settings: device, homes, environment, policy, learner,
rollout, weights. PyTorch is imported where it is used: composing a configuration needs none.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.cli import settings
from agents.cli.build import build
from agents.cli.errors import UserError
from agents.cli.run_folders import is_checkpoint

if TYPE_CHECKING:
    import torch

    from agents.checkpoint import Checkpoint
    from agents.policy import Policy
    from agents.ppo import PPO
    from agents.rollout import Rollout

#: Environments that are made to measure how much memory one takes.
PROBE = 65


@contextmanager
def errors() -> Iterator[None]:
    """Turns what the library says about bad arguments, files, devices and memory into a UserError.
    For setting up only.
    """
    import torch

    from agents.checkpoint import CheckpointError
    from agents.metrics import MetricsError
    from megastep.engine import EngineError

    try:
        yield
    except (
        ValueError,
        EngineError,
        CheckpointError,
        MetricsError,
        FileNotFoundError,
        torch.OutOfMemoryError,
    ) as error:
        raise UserError(str(error).splitlines()[0]) from error


def make_device(name: str) -> torch.device:
    """The device called `name`; a GPU becomes PyTorch's current one, on which graphs are
    captured.
    """
    import torch

    from megastep import engine

    with errors():
        chosen = engine.device(name)
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
    return chosen


def homes(geometry: settings.Geometry, split: str, max_homes: int | None = None) -> list[dict]:
    """The different geometries of a split, in order; the source repeats them when it runs out."""
    from megastep import geometries

    with errors():
        found = geometries.sample(
            geometry.name, geometry.n, split=split, seed=geometry.seed, **geometry.options
        )
    return list({id(home): home for home in found}.values())[:max_homes]


def make_env(
    chosen: settings.Env,
    homes: list[dict],
    seed: int,
    device: torch.device,
    bytes_beside: Callable[[Any], float] = lambda env: 0,
    privileged: bool = False,
) -> Any:
    """The environment that settings describe, in these homes. One that takes `privileged` is told
    whether a critic wants to see it.

    UserError that says how many environments fit, if these are too many for the memory;
    `bytes_beside(env)` is what each needs beside its own, in a rollout. Before a large one is made,
    two small ones tell what one environment takes.
    """
    from megastep import engine, envs
    from megastep.capture import state_tree

    constructor = envs.ENVS[chosen.name]
    arguments = dict(_arguments(chosen, "name", "n_envs"), seed=seed, device=device)
    if "privileged" in inspect.signature(constructor).parameters:
        arguments["privileged"] = privileged

    def make(n_envs, homes):
        return constructor(n_envs, homes, **arguments)

    with errors():
        if chosen.n_envs > PROBE:
            few, many = make(1, homes[:1]), make(PROBE, homes[:1])
            sizes = [
                sum(getattr(leaf, "nbytes", 0) for leaf in state_tree(env).values())
                for env in (few, many)
            ]
            each = (sizes[1] - sizes[0]) / (PROBE - 1) + bytes_beside(few)
            engine.fit(chosen.n_envs, each, device)
        return make(chosen.n_envs, homes)


def _arguments(chosen: Any, *others: str) -> dict[str, Any]:
    """Settings as keyword arguments, but for `others`, which are used elsewhere."""
    return {k: v for k, v in dataclasses.asdict(chosen).items() if k not in others}


def make_policy(agent: settings.Agent, env: Any, seed: int = 1) -> Policy:
    """The actor and its critic, to be trained."""
    return _make_policy(agent, env, seed, agent.critic)


def make_actor(agent: settings.Agent, env: Any) -> Policy:
    """The actor alone."""
    return _make_policy(agent, env, 1, None)


def _make_policy(agent, env, seed, critic):
    from agents.policy import Policy

    with errors():
        policy = Policy(
            env.obs_space,
            env.action_space,
            getattr(env, "privileged_space", None),
            critic=critic,
            seed=seed,
            **_arguments(agent, "critic"),
        )
        return policy.to(env.device)


def make_learner(learner: settings.Learner, policy: Policy, seed: int = 1) -> PPO:
    from agents.ppo import PPO

    arguments = _arguments(learner, "name", "n_steps", "anneal")
    return PPO(policy, graph=True, seed=seed, **arguments)


def make_rollout(cfg: settings.Train, env: Any, policy: Policy) -> Rollout:
    from agents.rollout import Rollout

    n_lanes = env.n_envs * env.n_agents
    with errors():
        return Rollout(
            cfg.learner.n_steps,
            n_lanes,
            env.obs_space,
            env.action_space,
            policy.initial(n_lanes),
            env.device,
            policy.privileged_space,
        )


def rollout_bytes(cfg: settings.Train, env: Any) -> float:
    """About how many bytes a rollout and a minibatch of it take per environment."""
    from megastep.dotdict import leaves

    numbers, privileged = (
        sum(math.prod(space.shape) for space in leaves(getattr(env, name, None) or {}))
        for name in ("obs_space", "privileged_space")
    )
    steps, width, parts = cfg.learner.n_steps + 1, cfg.agent.width, cfg.learner.n_minibatches
    # observations of 2 bytes per number, 4 of what is privileged, and about 64 of the rest; a
    # minibatch's share of those, and of some 24 activations of 4 bytes per unit; the features that
    # values are made of
    each = 2 * numbers + 4 * privileged + 64
    return env.n_agents * steps * (each * (1 + 1 / parts) + (96 / parts + 4) * width)


def load(path: Path, device: torch.device | str = "cpu") -> Checkpoint:
    """The checkpoint of a run found with `find`; damaged ones are named in warnings and skipped."""
    from agents import checkpoint

    with errors():
        return checkpoint.load(path if is_checkpoint(path) else path / "checkpoints", device)


def config_of(checkpoint: Checkpoint) -> settings.Train:
    """The settings that a checkpoint was trained with."""
    return build(settings.Train, checkpoint.config["train"])


def spaces_of(env: Any) -> dict[str, str]:
    """The spaces of an environment by name, as text: {'obs.rgb': 'MultiImage(...)', ...}."""

    def flat(space, name):
        if not isinstance(space, dict):
            return {name: repr(space)}
        return {
            k: v for key, child in space.items() for k, v in flat(child, f"{name}.{key}").items()
        }

    return {**flat(env.obs_space, "obs"), **flat(env.action_space, "actions")}


def load_weights(policy: Policy, env: Any, checkpoint: Checkpoint) -> None:
    """Loads a checkpoint's weights into a policy made for `env`, the critic's too if it has one.
    UserError that names what differs if they do not fit.
    """
    saved, present = checkpoint.config["spaces"], spaces_of(env)
    differing = [
        f"{name} was {saved.get(name, 'absent')} and is {present.get(name, 'absent')}"
        for name in {**saved, **present}
        if saved.get(name) != present.get(name)
    ]
    if differing:
        raise UserError(
            f"{checkpoint.path} was trained in another environment: {'; '.join(differing)}; "
            "choose the env it was trained in"
        )
    weights, own = checkpoint.state["policy"], policy.state_dict()
    had, has = ("critic.intake.project.weight" in found for found in (weights, own))
    if policy.critic is not None and had != has:
        kinds = {True: "asymmetric", False: "plain"}
        raise UserError(
            f"The critic of {checkpoint.path} is {kinds[had]} and this run's is {kinds[has]}: give "
            f"agent.critic={kinds[had]}"
        )
    shapes = {name: tuple(weights[name].shape) if name in weights else "absent" for name in own}
    shapes = [
        f"{name} is {shapes[name]} and should be {tuple(value.shape)}"
        for name, value in own.items()
        if shapes[name] != tuple(value.shape)
    ]
    if shapes:
        raise UserError(
            f"The weights of {checkpoint.path} do not fit this agent: {shapes[0]}; choose the "
            f"agent it has"
        )
    policy.load_state_dict({name: weights[name] for name in own})
