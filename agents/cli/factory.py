"""Builds the objects of a run from its settings: device, homes, environment, policy, learner."""

import dataclasses
import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from megastep import contract, engine, spaces
from megastep.agents.algorithms.learner import LearnerError, check_learner
from megastep.agents.cli import runs
from megastep.agents.cli.check import check
from megastep.agents.cli.program import ConfigErrors, UserError, first_line, shortened
from megastep.agents.cli.settings import Agent, Env, Geometry, Learner, Train
from megastep.agents.imports import import_object
from megastep.agents.networks.policy import Policy
from megastep.agents.selfplay.opponents import Opponents
from megastep.agents.training import checkpoint
from megastep.agents.training.evaluation import RandomActions
from megastep.agents.training.loggers import LoggerError
from megastep.capture import state_tree

#: Number of environments in which the memory of one is measured.
PROBE = 65
#: Environments of a sample, and the steps in which they must keep the contract.
SAMPLE, SAMPLE_STEPS = 4, 16
#: What the library raises for bad arguments, files, devices and for missing memory.
KINDS = (
    ValueError,
    OSError,
    engine.EngineError,
    torch.OutOfMemoryError,
    checkpoint.CheckpointError,
    LoggerError,
    LearnerError,
    contract.ContractError,
)


@contextmanager
def errors(prefix: str = "", kinds: tuple[type, ...] = KINDS) -> Iterator[None]:
    """Turns errors of the library into a UserError that begins with `prefix`. For setting up."""
    try:
        yield
    except kinds as error:
        raise UserError(prefix + shortened(first_line(error), 400)) from error


def construct(settings: Any, **arguments: Any) -> Any:
    """Calls the class or function that settings name, with all of both that it takes."""
    with errors():
        constructor = import_object(settings.name)
        taken = inspect.signature(constructor).parameters
        return constructor(**{k: v for k, v in (vars(settings) | arguments).items() if k in taken})


def changed(settings: Any, **changes: Any) -> Any:
    """Returns settings with those changed that they have."""
    known = {name: value for name, value in changes.items() if hasattr(settings, name)}
    return dataclasses.replace(settings, **known)


def make_device(name: str) -> torch.device:
    """Returns a device by name. A GPU becomes PyTorch's current one, on which graphs are captured."""
    with errors():
        device = engine.device(name)
    if device.type == "cuda":
        torch.cuda.set_device(device)
    return device


def homes(env: Env, geometry: Geometry, split: str, max_homes: int | None = None) -> list[dict]:
    """Returns the different geometries of a split, in order; none if `env` takes no geometries."""
    if "geometries" not in inspect.signature(import_object(env.name)).parameters:
        return []
    sampled = construct(geometry, split=split)
    return list({id(home): home for home in sampled}.values())[:max_homes]


def make_env(
    env: Env, homes: list[dict], seed: int, device: torch.device, privileged: bool = False
) -> Any:
    """Returns the environment that settings describe, in these homes.

    `privileged`: whether a critic wants the privileged observation.
    """
    return construct(env, geometries=homes, seed=seed, device=device, privileged=privileged)


def make_sample(env: Env, homes: list[dict], *arguments: Any) -> Any:
    """Returns a small environment of the same kind, which tells spaces and sizes.

    Raises:
        UserError: naming the clause of the contract that a class of the user's breaks.
    """
    is_ours = env.name.startswith("megastep.")
    n_envs = 1 if is_ours else min(SAMPLE, env.n_envs)
    sample = make_env(dataclasses.replace(env, n_envs=n_envs), homes[:1], *arguments)
    if not is_ours:
        with errors(f"{env.name}: "):
            contract.rollout(sample, SAMPLE_STEPS)
    return sample


def check_memory(
    env: Env, sample: Any, n_bytes: float, homes: list[dict], seed: int, device: Any, *rest: Any
) -> None:
    """Raises UserError with the number that fits, if there are too many environments for the memory.

    `n_bytes` is what each takes beside its own memory, in a rollout. `sample` gives an upper bound,
    as it counts what environments share; only if that does not fit, more of them are made.
    """

    def total(env):
        return sum(getattr(leaf, "nbytes", 0) for leaf in state_tree(env).values())

    try:
        engine.fit(env.n_envs, total(sample) + n_bytes, device)
    except engine.EngineError:
        probe = dataclasses.replace(env, n_envs=PROBE)
        more = total(make_env(probe, homes[:1], seed, device, *rest)) - total(sample)
        with errors():
            engine.fit(env.n_envs, more / (PROBE - sample.n_envs) + n_bytes, device)


def make_policy(agent: Agent, env: Any, seed: int = 1, critic: str | None = None) -> Policy:
    """Returns a policy on the environment's device; without a `critic` it can only act."""
    if torch.device(env.device).type == "cpu":
        share_threads(agent.width)
    privileged, arguments = getattr(env, "privileged_space", None), vars(agent) | {"critic": critic}
    with errors():
        policy = Policy(env.obs_space, env.action_space, privileged, seed=seed, **arguments)
    return policy.to(env.device)


def share_threads(width: int) -> None:
    """Gives the engine all threads of the CPU, and PyTorch one per 128 units of a layer: in smaller
    layers, threads lose more by waiting for each other than they gain.
    """
    n_threads = engine.threads()
    engine.set_threads(n_threads)
    torch.set_num_threads(max(1, min(n_threads, width // 128)))


def make_learner(learner: Learner, policy: Policy, seed: int = 1) -> Any:
    """Returns the learner that settings describe, to improve a policy."""
    learns = construct(learner, policy=policy, seed=seed, graph=True)
    with errors(f"{learner.name} is no learner: "):
        check_learner(learns)
    return learns


def replay_bytes(learner: Any, env: Any) -> float:
    """Returns the bytes of a learner's replay buffer, 0 without one; `env` is a small environment.

    Raises:
        UserError: with the number of observations that fits.
    """
    if not hasattr(learner, "replay_size"):
        return 0.0
    with errors():
        n, n_bytes = learner.replay_size(env)
        engine.fit(n, n_bytes, env.device, "observations of learner.replay.capacity")
    return n * n_bytes


def make_opponents(cfg: Train, env: Any, sample: Any, policy: Policy) -> Opponents | None:
    """Returns the environment with opponents in it, None if there are to be none.

    `sample` is a small environment, in which a scripted opponent is tried.

    Raises:
        UserError: if the opponent cannot play there; with the number of snapshots that fits.
    """
    opponents = cfg.opponents
    if not (opponents.past or opponents.bot):
        return None
    bot = make_bot(opponents.bot_class, cfg.env, sample) if opponents.bot else None
    with errors():
        if opponents.past:
            n_copies = 2 if torch.device(env.device).type == "cuda" else 1  # one for the graph
            n_bytes = n_copies * sum(w.nbytes for w in policy.actor().state_dict().values())
            engine.fit(opponents.snapshots, n_bytes, env.device, "snapshots")
        shares = {name: value for name, value in vars(opponents).items() if name != "bot_class"}
        return Opponents(env, policy, bot, seed=cfg.seed, **shares)


def make_bot(name: str, settings: Env, env: Any) -> Any:
    """Returns a policy that needs no weights: `random`, or a class by import path.

    The class is given the environment's settings that it takes, such as `fov`, and takes one step
    in `env`. Raises UserError if it cannot play there.
    """
    if name == "random":
        return RandomActions(env.action_space)
    with errors():
        taken = inspect.signature(constructor := import_object(name)).parameters
    cure = f"{name} cannot play in {type(env).__name__}; name a policy made for it: "
    with errors(cure, (Exception,)):  # whatever it does where it was not made for
        bot = constructor(**{key: value for key, value in vars(settings).items() if key in taken})
        n_lanes = env.n_envs * env.n_agents
        actions = bot(env.reset(), bot.initial(n_lanes, env.device))[0]["actions"]
        spaces.map(lambda space, leaf: _check_actions(space, leaf, n_lanes), env.action_space, actions)
    return bot


def _check_actions(space, actions, n_lanes):
    has_shape = tuple(actions.shape) == (n_lanes, *space.shape) and not actions.is_floating_point()
    if not has_shape or not ((actions >= 0) & (actions < space.n_actions)).all():
        raise ValueError(f"its actions are not those of {space!r}")


def load_checkpoint(path: Path, device: torch.device | str = "cpu") -> checkpoint.Checkpoint:
    """Returns the checkpoint of a run found with `runs.find`. Warns of damaged ones it skips."""
    with errors():
        return checkpoint.load_latest(runs.checkpoints_of(path), device)


def config_of(loaded: checkpoint.Checkpoint) -> Train:
    """Returns the settings that a checkpoint was trained with. Raises UserError if they cannot be
    used here.
    """
    try:
        return check(Train, loaded.config["train"])
    except ConfigErrors as error:
        (key, sentence), *_ = error.errors
        raise UserError(f"{loaded.path} cannot be used: {key}: {sentence}") from None


def spaces_of(env: Any) -> dict[str, str]:
    """Returns the spaces of an environment as text: {'obs.rgb': 'MultiImage(...)', ...}."""
    leaves = spaces.leaves(env.obs_space, "obs") | spaces.leaves(env.action_space, "actions")
    return {name: repr(space) for name, space in leaves.items()}


def load_weights(policy: Policy, env: Any, loaded: checkpoint.Checkpoint) -> None:
    """Loads a checkpoint's weights into a policy made for `env`, the critic's too if it has one.

    Raises:
        UserError: naming what differs, if they do not fit.
    """
    if differing := _differences(loaded.config["spaces"], spaces_of(env)):
        raise UserError(
            f"{loaded.path} was trained in another environment: {'; '.join(differing)}. "
            "Choose the env it was trained in"
        )
    saved, present = loaded.state["policy"], policy.state_dict()
    kinds = [
        "asymmetric" if "critic.intake.project.weight" in weights else "plain"
        for weights in (saved, present)
    ]
    if policy.critic is None:  # what only training needs
        saved = {k: v for k, v in saved.items() if not k.startswith(("critic.", "prediction."))}
    elif kinds[0] != kinds[1]:
        raise UserError(
            f"The critic of {loaded.path} is {kinds[0]} and this run's is {kinds[1]}; "
            f"use agent.critic={kinds[0]}"
        )
    shapes = ({k: tuple(v.shape) for k, v in weights.items()} for weights in (saved, present))
    if differing := _differences(*shapes):
        raise UserError(
            f"The weights of {loaded.path} do not fit this agent: {differing[0]}. "
            "Use the agent settings it was trained with"
        )
    policy.load_state_dict({name: saved[name] for name in present})


def _differences(saved: dict, present: dict) -> list[str]:
    return [
        f"{name} was {saved.get(name, 'absent')} and is {present.get(name, 'absent')}"
        for name in {**present, **saved}
        if saved.get(name) != present.get(name)
    ]
