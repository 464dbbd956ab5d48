"""The objects a run is made of, from its settings: device, homes, environment, policy, learner,
rollout, weights. PyTorch is imported where it is used: composing a configuration needs none.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from megastep.agents.cli import settings
from megastep.agents.cli.build import build
from megastep.agents.cli.errors import ConfigErrors, UserError, shortened
from megastep.agents.cli.run_folders import is_checkpoint
from megastep.agents.imports import import_object

if TYPE_CHECKING:
    import torch

    from megastep.agents.networks.policy import Policy
    from megastep.agents.selfplay.opponents import Opponents
    from megastep.agents.training.checkpoint import Checkpoint

#: Environments that are made to measure how much memory one takes.
PROBE = 65
#: Environments of a sample, and steps that they take where they have to keep the contract.
SAMPLE, SAMPLE_STEPS = 4, 16


@contextmanager
def errors() -> Iterator[None]:
    """Turns what the library says about bad arguments, files, devices and memory into a UserError.
    For setting up only.
    """
    import torch

    from megastep.agents.training.checkpoint import CheckpointError
    from megastep.agents.training.loggers import LoggerError
    from megastep.engine import EngineError

    try:
        yield
    except (
        ValueError,
        EngineError,
        CheckpointError,
        LoggerError,
        OSError,
        torch.OutOfMemoryError,
    ) as error:
        raise UserError(shortened(str(error).splitlines()[0], 400)) from error


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


def homes(
    env: settings.Env, geometry: settings.Geometry, split: str, max_homes: int | None = None
) -> list[dict]:
    """The different geometries of a split, in order; the source repeats them when it runs out. None
    for an environment that takes no geometries.
    """
    if not _takes(env, "geometries"):
        return []
    with errors():
        found = import_object(geometry.name)(split=split, **_arguments(geometry, "name"))
    return list({id(home): home for home in found}.values())[:max_homes]


def make_env(
    chosen: settings.Env,
    homes: list[dict],
    seed: int,
    device: torch.device,
    privileged: bool = False,
    sample: Any = None,
    bytes_beside: float = 0,
) -> Any:
    """The environment that settings describe, in these homes. It is given what its constructor
    takes of geometries, seed and device, and of `privileged`: whether a critic wants to see that.

    UserError that says how many environments fit, if these are too many for the memory;
    `bytes_beside` is what each needs beside its own, in a rollout. Before a large one is made, two
    small ones tell what one environment takes; the `sample` of `make_sample` may be one of them.
    """
    from megastep import engine
    from megastep.capture import state_tree

    constructor = import_object(chosen.name)

    def make(n_envs, homes):
        run = dict(geometries=homes, seed=seed, device=device, privileged=privileged)
        run = {name: value for name, value in run.items() if _takes(chosen, name)}
        return constructor(n_envs=n_envs, **_arguments(chosen, "name", "n_envs"), **run)

    with errors():
        if chosen.n_envs > PROBE:
            few, many = sample or make(1, homes[:1]), make(PROBE, homes[:1])
            sizes = [
                sum(getattr(leaf, "nbytes", 0) for leaf in state_tree(env).values())
                for env in (few, many)
            ]
            each = (sizes[1] - sizes[0]) / (many.n_envs - few.n_envs)
            engine.fit(chosen.n_envs, each + bytes_beside, device)
        return make(chosen.n_envs, homes)


def make_sample(
    chosen: settings.Env,
    homes: list[dict],
    seed: int,
    device: torch.device,
    privileged: bool = False,
) -> Any:
    """An environment of the kind that settings describe, which tells spaces and sizes; a few if the
    class is not ours, which is tested elsewhere. UserError that names the clause of the contract
    that they break.
    """
    from megastep import contract

    is_ours = chosen.name.startswith("megastep.")
    few = dataclasses.replace(chosen, n_envs=1 if is_ours else min(SAMPLE, chosen.n_envs))
    env = make_env(few, homes[:1], seed, device, privileged)
    if not is_ours:
        try:
            contract.rollout(env, SAMPLE_STEPS)
        except contract.ContractError as error:
            raise UserError(f"{error} ({chosen.name})") from error
    return env


def _takes(chosen: Any, argument: str) -> bool:
    """Whether the class or function that settings name takes an argument."""
    return argument in inspect.signature(import_object(chosen.name)).parameters


def _arguments(chosen: Any, *others: str) -> dict[str, Any]:
    """Settings as keyword arguments, but for `others`, which are used elsewhere."""
    names = [field.name for field in dataclasses.fields(chosen)]
    return {name: getattr(chosen, name) for name in names if name not in others}


def make_policy(agent: settings.Agent, env: Any, seed: int = 1) -> Policy:
    """The actor and its critic, to be trained."""
    return _make_policy(agent, env, seed, agent.critic)


def make_actor(agent: settings.Agent, env: Any) -> Policy:
    """The actor alone."""
    return _make_policy(agent, env, 1, None)


def share_threads(width: int) -> None:
    """Gives the engine all threads of the CPU, and PyTorch one for every 128 units of a network
    there: where layers are smaller, waiting for each other costs threads more than they do.
    """
    import torch

    from megastep import engine

    n_threads = engine.threads()
    engine.set_threads(n_threads)
    torch.set_num_threads(max(1, min(n_threads, width // 128)))


def _make_policy(agent, env, seed, critic):
    import torch

    from megastep.agents.networks.policy import Policy

    if torch.device(env.device).type == "cpu":
        share_threads(agent.width)
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


def make_learner(learner: settings.Learner, policy: Policy, seed: int = 1) -> Any:
    """What improves the policy, which `megastep.agents.algorithms.learner` describes. It is given what its constructor
    takes of seed and of `graph`: whether to capture its update.
    """
    from megastep.agents.algorithms.learner import LearnerError, check_learner

    run = {k: v for k, v in dict(seed=seed, graph=True).items() if _takes(learner, k)}
    with errors():
        made = import_object(learner.name)(
            policy=policy, **_arguments(learner, "name", "anneal"), **run
        )
    try:
        check_learner(made)
    except LearnerError as error:
        raise UserError(f"{learner.name} is no learner: {error}") from None
    return made


def replay_bytes(learner: Any, env: Any) -> float:
    """What a learner's replay memory takes, 0 if it has none. UserError that says how many
    observations fit, if they are too many for the memory; `env` is a small environment.
    """
    from megastep import engine

    if not hasattr(learner, "replay_size"):
        return 0.0
    with errors():
        n, each = learner.replay_size(env)
        engine.fit(n, each, env.device, "observations of learner.replay.capacity")
    return n * each


def make_opponents(cfg: settings.Train, env: Any, sample: Any, policy: Policy) -> Opponents | None:
    """The environment with opponents in it, or None where there shall be none. UserError that says
    how many snapshots fit, if they are too many for the memory; `sample` is a small environment, in
    which a scripted opponent is tried.
    """
    import torch

    from megastep import engine
    from megastep.agents.selfplay.opponents import Opponents

    chosen = cfg.opponents
    if not (chosen.past or chosen.bot):
        return None
    scripted = make_bot(chosen.bot_class, cfg.env, sample) if chosen.bot else None
    with errors():
        if chosen.past:
            weights = policy.actor().state_dict().values()
            copies = 2 if torch.device(env.device).type == "cuda" else 1  # of which one to capture
            each = copies * sum(weight.nbytes for weight in weights)
            engine.fit(chosen.snapshots, each, env.device, "snapshots")
        shares = _arguments(chosen, "bot_class")
        return Opponents(env, policy, scripted, seed=cfg.seed, **shares)


def make_bot(name: str, chosen: settings.Env, env: Any) -> Any:
    """A policy that needs no weights, by import path or `random`, for an environment of these
    settings: it is given those that its constructor takes, `fov` say, and takes one step in `env`,
    whose episodes start anew. UserError if it cannot play there.
    """
    from megastep.agents.training.evaluation import RandomActions

    if name == "random":
        return RandomActions(env.action_space)
    with errors():
        made = import_object(name)
    try:
        names = inspect.signature(made).parameters
        bot = made(**{name: getattr(chosen, name) for name in names if hasattr(chosen, name)})
        n_lanes = env.n_envs * env.n_agents
        decision, _ = bot(env.reset(), bot.initial(n_lanes, env.device))
        if not _are_of(env.action_space, decision["actions"], n_lanes):
            raise ValueError(f"its actions are not those of {env.action_space!r}")
    except Exception as error:  # whatever it does where it was not made for
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(
            f"{name} cannot play in {type(env).__name__}: {reason}; name one that is made for it"
        ) from error
    return bot


def _are_of(space, actions, n_lanes):
    """Whether actions of all lanes are of a space."""
    if isinstance(space, dict):
        return all(_are_of(child, actions[key], n_lanes) for key, child in space.items())
    fits = tuple(actions.shape) == (n_lanes, *space.shape) and not actions.is_floating_point()
    return fits and bool(((actions >= 0) & (actions < space.n_actions)).all())


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> Checkpoint:
    """The checkpoint of a run found with `find`; damaged ones are named in warnings and skipped."""
    from megastep.agents.training import checkpoint

    with errors():
        return checkpoint.load_latest(path if is_checkpoint(path) else path / "checkpoints", device)


def config_of(checkpoint: Checkpoint) -> settings.Train:
    """The settings that a checkpoint was trained with. UserError if they cannot be used here."""
    try:
        return build(settings.Train, checkpoint.config["train"])
    except ConfigErrors as error:
        (key, sentence), *_ = error.errors
        raise UserError(f"{checkpoint.path} cannot be used: {key}: {sentence}") from None


def spaces_of(env: Any) -> dict[str, str]:
    """The spaces of an environment by name, as text: {'obs.rgb': 'MultiImage(...)', ...}."""

    def flat(space, name):
        if not isinstance(space, dict):
            return {name: repr(space)}
        return {
            k: v for key, child in space.items() for k, v in flat(child, f"{name}.{key}").items()
        }

    return {**flat(env.obs_space, "obs"), **flat(env.action_space, "actions")}


def _shapes(tensors):
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}


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
    # what only training needs may be left over where there is no critic
    needed = {
        name: value
        for name, value in weights.items()
        if policy.critic is not None or not name.startswith(("critic.", "prediction."))
    }
    saved, present = _shapes(needed), _shapes(own)
    for name in {**present, **saved}:
        was, should = saved.get(name, "absent"), present.get(name, "absent")
        if was != should:
            raise UserError(
                f"The weights of {checkpoint.path} do not fit this agent: {name} is {was} and "
                f"should be {should}; choose the agent it has"
            )
    policy.load_state_dict({name: weights[name] for name in own})
