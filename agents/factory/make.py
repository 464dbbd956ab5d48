"""Builds the objects of a run from its settings: device, homes, environment, policy, learner."""

import copy
import functools
import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from megastep import contract, devices, engine, scene, spaces, types
from megastep.agents.distributed import environment
from megastep.agents.errors import ConfigErrors, UserError, user_errors
from megastep.agents.factory import check, components, settings
from megastep.agents.factory.components import env_name, label
from megastep.agents.factory.settings import Agent, Env, Geometry, Learner, Played, Train, Trained
from megastep.agents.generator import stream_seed
from megastep.agents.networks.policy import Policy, share_threads
from megastep.agents.runs import checkpoint, folders, restore
from megastep.agents.runs.saver import check_plain, nbytes
from megastep.agents.selfplay.bots import BOTS
from megastep.agents.selfplay.opponents import Opponents
from megastep.agents.types import LearnerOptions, with_defaults
from megastep.capture import state_tree
from megastep.imports import import_object
from megastep.settings import already_checked, parameters_of
from megastep.types import PolicyLike, n_lanes, optional

if TYPE_CHECKING:
    from megastep.agents import types as agent_types
    from megastep.agents.factory.settings import Component

#: Number of environments in which the memory of one is measured.
PROBE = 65
#: Environments of a sample, and the steps in which they must keep the contract.
SAMPLE, SAMPLE_STEPS = 4, 16
#: What the library raises for bad arguments, files and devices, and for too little memory.
KINDS = (
    *(ValueError, OSError, torch.OutOfMemoryError, engine.EngineError, contract.ContractError),
    checkpoint.CheckpointError,
)
#: Turns these errors into a UserError that begins with a prefix. For setting up.
errors = functools.partial(user_errors, kinds=KINDS)


def make_device(name: str) -> torch.device:
    """Returns the device `auto`, `cpu`, `cuda`, of which each rank has its own, or `cuda:1`, and
    makes a GPU the current one. Raises UserError if there is none.
    """
    with user_errors(kinds=(ValueError, engine.EngineError)):
        info = environment.rank_info()
        if info and (name == "cuda" or (name == "auto" and torch.cuda.is_available())):
            name = f"cuda:{info.local_rank}"
        device = devices.device(name)
    if device.type == "cuda":
        torch.cuda.set_device(device)  # on which graphs are captured
    return device


def construct(settings: "Component", constructor: Callable | None = None, **arguments: Any) -> Any:
    """Calls a class or function, by default `settings.name`, with the arguments that it takes."""
    with errors():
        is_env = constructor is None and hasattr(settings, "wrappers")
        constructor = constructor or import_object(settings.name)
        taken, own = parameters_of(constructor), inspect.signature(constructor).parameters
        values = {}
        for key, value in vars(settings).items():
            default = taken[key].default if key in taken else value
            # of what goes on to a base class, defaults are left out: a class may fix one
            if key in own or (value is not default and value != default):
                # an environment may change a list that it is given, and the next gets it whole
                values[key] = copy.deepcopy(value) if type(value) in (dict, list) else value
        values |= {key: value for key, value in arguments.items() if key in taken}
        inside, outside = [], []
        if is_env and settings.wrappers:
            inside, outside = _wrappers_of(settings, taken)
        if is_env and "wrappers" in taken:
            values["wrappers"] = tuple(inside)
        try:
            with already_checked(constructor.__module__.startswith("megastep.")):
                made = constructor(**values)
            for number, wrapper in enumerate(outside):
                seed = stream_seed(arguments.get("seed", 1), f"wrapper {number}")
                made = construct(wrapper, env=made, seed=seed)
            return made
        except TypeError as error:
            if "multiple values" not in str(error):
                raise
            cure = "an argument that it sets itself belongs in its own signature"
            raise ValueError(f"{settings.name} cannot be made: {error}; {cure}") from error


def _wrappers_of(settings, taken) -> tuple[list[str], list]:
    """Returns the wrappers of an environment's own package, and the settings of megastep's."""
    from megastep.wrappers import Wrapper

    inside, outside = [], []
    for item in settings.wrappers:
        name = item["name"] if isinstance(item, dict) else item
        kind = import_object(name) if ":" in name else Wrapper
        if inspect.isclass(kind) and issubclass(kind, Wrapper):
            outside.append(components.wrapper_settings(item))
        elif "wrappers" in taken and not isinstance(item, dict):
            inside.append(name)
        else:
            text = "takes no settings here; derive a class that has them"
            if "wrappers" not in taken:
                text = f"cannot be used, as {env_name(settings)} takes none of another package"
            raise ValueError(f"env.wrappers: {name} is no megastep.wrappers.Wrapper and {text}")
    return inside, outside


def homes(env: Env, geometry: Geometry, split: str) -> list[dict]:
    """Returns the different geometries of a split, in order; none if `env` takes no geometries."""
    if not components.takes_geometries(env.name):
        return []
    return [*{id(home): home for home in construct(geometry, split=split)}.values()]


def played_in(
    cfg: Played, loaded: checkpoint.Checkpoint | None = None
) -> tuple[Env, Geometry, list[dict]]:
    """Returns environment, geometry and homes: those of `cfg`, else those of a training."""
    trained: Any = loaded and config_of(loaded)
    env: Any = cfg.env or (trained and trained.env)
    if cfg.geometry is not None and not components.takes_geometries(env.name):
        raise UserError(
            f"{env_name(env)} takes no floor plans, so it cannot be played in "
            f"geometry={label(cfg.geometry.name)}; leave geometry out"
        )
    geometry = cfg.geometry or (trained and trained.geometry)
    geometry = geometry or components.settings_for("geometry", components.HOMES)
    return env, geometry, homes(env, geometry, cfg.split)


def spread(homes: list[dict], n_envs: int) -> list[dict]:
    """Returns the homes, or `n_envs` evenly spaced ones of more. Without homes, returns none."""
    return scene.spread(homes, n_envs) if homes else []


def make_sample(env: Env, geometries: list[dict], **arguments) -> types.Env:
    """Returns a small environment of the same kind; one of a user's must keep the contract."""
    names = [item["name"] if isinstance(item, dict) else item for item in env.wrappers]
    is_ours = all(":" not in name for name in names) and env.name.startswith("megastep.")
    n_envs = 1 if is_ours else min(SAMPLE, env.n_envs)
    sample = construct(settings.changed(env, n_envs=n_envs), geometries=geometries[:1], **arguments)
    if not is_ours:
        with errors(f"{env.name}: "):
            contract.rollout(sample, SAMPLE_STEPS)
    return sample


def check_memory(
    env: Env, sample: types.Env, learner: object, geometries: list, n_members: int = 1, **arguments
) -> None:
    """Raises UserError, with the number that fits, if memory is too small."""
    n_things, n_each, what = env.n_envs, 1, "environments"
    if n_members > 1:
        n_things, n_each, what = n_members, env.n_envs, "members (population.size)"
    options = with_defaults(learner, LearnerOptions)
    n_bytes = options.bytes_per_env(sample)
    n, each = options.replay_size(sample)
    total = nbytes(state_tree(sample))
    with errors():
        engine.fit(n, each, sample.device, "observations of learner.replay.capacity")
        n_bytes += n * each / env.n_envs
        try:
            engine.fit(n_things, n_each * (total + n_bytes), sample.device, what)
        except engine.EngineError:
            if env.n_envs > PROBE:  # fewer tell for themselves whether they fit
                probe = settings.changed(env, n_envs=PROBE)
                probe = construct(probe, geometries=geometries[:1], **arguments)
                n_bytes += (nbytes(state_tree(probe)) - total) / (PROBE - sample.n_envs)
                engine.fit(n_things, n_each * n_bytes, sample.device, what)
            elif n_members > 1:
                raise


def make_policy(agent: Agent, env: types.Env, seed: int = 1, critic: str | None = None) -> Policy:
    """Returns a policy on the environment's device; without a `critic` it can only act."""
    if torch.device(env.device).type == "cpu":
        share_threads(agent.width)
    with errors():
        spaces = env.obs_space, env.action_space, optional(env, "privileged_space")
        arguments: dict = vars(agent) | {"critic": critic}
        with already_checked():
            return Policy(*spaces, seed=seed, **arguments).to(env.device)


def make_learner(settings: Learner, policy: Policy, seed: int = 1) -> "agent_types.Learner":
    learner = construct(settings, policy=policy, seed=seed, graph=True)
    if not settings.name.startswith("megastep."):
        problem = f"{settings.name} is not a learner"
        for name in ("collector", "update", "lr", "state_dict", "load_state_dict"):
            if not hasattr(learner, name):
                raise UserError(
                    f"{problem}: it has no {name}: see docs/learners.md, Writing a learner"
                )
        with user_errors(f"{problem}: ", (TypeError,)):
            check_plain(learner.state_dict(), "state_dict")
    return learner


def sources_of(geometries: Sequence[Mapping]) -> list[str] | None:
    """Returns the `source` of each geometry, which `geometry=mixed` sets; None if one has none."""
    sources = [g.get("source") if isinstance(g, Mapping) else None for g in geometries]
    return None if None in sources else [*map(str, sources)] or None


def make_opponents(
    cfg: Train, env: types.Env, sample: types.Env, policy: Policy, seed: int = 1
) -> Opponents:
    """Returns the environment with opponents in it. A `sample` tries the bot."""
    chosen, bot = cfg.opponents, None
    if chosen.bot:
        bot = in_env(make_bot(chosen.bot_class, cfg.env, sample), cfg.env, env)
    with errors():
        if chosen.past or chosen.league:
            n_bytes = sum(weight.nbytes for weight in policy.actor().state_dict().values())
            n_bytes *= 2 if torch.device(env.device).type == "cuda" else 1  # one for the graph
            engine.fit(chosen.snapshots, n_bytes, env.device, "snapshots")
        options = {key: value for key, value in vars(chosen).items() if key != "bot_class"}
        return Opponents(env, policy, bot, seed=seed, **options)


def make_bot(name: str | None, settings: Env, env: types.Env) -> PolicyLike:
    """Returns a policy that does not learn, which takes one step in `env`; UserError if it cannot
    play. `name`: one of `BOTS`, an import path, a run, whose agent it is, or "bot": `env.bot`.
    """
    where, name = type(env).__name__, None if name == "bot" else name
    if name and name not in BOTS and ":" not in name:
        path = find_or_name_bots(name)
        return restore.policy_of(folders.load_checkpoint(path, False, env.device), env)
    with errors():
        constructor = import_object(BOTS.get(name, name)) if name else optional(env, "bot")
    if constructor is None:
        raise UserError(
            f"{where} has no bot of its own; name one, such as {', '.join(BOTS)} or module:Class: "
            "opponents.bot_class= in training, against= or baseline= in an evaluation"
        )
    name = name or f"{where}.bot"

    def check_actions(space, leaf) -> None:
        if len(leaf) != n_lanes(env) or not spaces.are_actions(space, leaf):
            raise ValueError(f"its actions are not those of {space!r}")

    # a policy may do whatever, where it was not made for
    with user_errors(f"{name} cannot play in {where}; name one made for it: ", (Exception,)):
        bot = construct(settings, constructor, env=env, action_space=env.action_space)
        decision, _ = bot(env.reset(), bot.initial(n_lanes(env), env.device))
        spaces.map(check_actions, env.action_space, decision["actions"])
    return bot


def find_or_name_bots(name: str) -> Path:
    """Returns the path of who is no bot, see `folders.find`. UserError names the bots."""
    try:
        return folders.find(name)
    except UserError as error:
        bots = "" if os.path.exists(name) else f" (bots are bot, {', '.join(BOTS)})"
        raise UserError(f"{error}{bots}") from None


def in_env(bot: PolicyLike, settings: Env, env: types.Env) -> PolicyLike:
    """Returns the bot for another environment of the same settings: a new one if it takes `env`."""
    takes_env = "env" in inspect.signature(type(bot)).parameters
    return construct(settings, type(bot), env=env) if takes_env else bot


def config_of(loaded: checkpoint.Checkpoint) -> Trained:
    """Returns what a checkpoint's agent was trained in. UserError if it cannot be used."""
    train = loaded.config["train"]
    tree = {key: train[key] for key in Trained.__dataclass_fields__ if key in train}
    with user_errors(f"{loaded.path} cannot be used: ", (ConfigErrors,)):
        return check.check(Trained, tree)
