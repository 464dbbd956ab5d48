"""Who plays in an evaluation: agents of runs, packaged agents, and bots."""

import warnings
from pathlib import Path
from typing import NamedTuple

import torch

from megastep.agents import factory
from megastep.agents.errors import UserError
from megastep.agents.factory import settings
from megastep.agents.runs import checkpoint, folders, restore
from megastep.agents.selfplay.bots import BOTS
from megastep.types import Env, PolicyLike


class Player(NamedTuple):
    name: str
    policy: PolicyLike
    step: int | None = None  # the number of samples it has learnt from


def load_player(loaded: checkpoint.Checkpoint, env: Env, run: checkpoint.Checkpoint) -> Player:
    """Returns the player of a checkpoint, to meet the agent of `run` in `env`.

    Raises:
        UserError: if one was trained in another environment.
    """
    trained, own = factory.config_of(loaded), factory.config_of(run)
    if trained.env.name != own.env.name:
        raise UserError(
            f"{loaded.path} was trained in {settings.label(trained.env.name)} and {run.path} in "
            f"{settings.label(own.env.name)}; choose a run in the same environment"
        )
    policy = restore.policy_of(loaded, env)
    if _of_wrappers(loaded) != _of_wrappers(run):
        warnings.warn(
            f"{loaded.path} observes through what the wrappers of {run.path} have learnt, not its "
            "own",
            stacklevel=3,
        )
    return Player(f"{folders.name_of(loaded.path)}, {loaded.step:,} samples", policy, loaded.step)


def _of_wrappers(loaded) -> dict:
    state = (loaded.state or {}).get("wrappers", {})
    return {name: torch.as_tensor(value).tolist() for name, value in state.items()}


def find_player(
    name: str, run: checkpoint.Checkpoint, env_settings: settings.Env, env: Env, trust: bool
) -> Player:
    """Returns who is to meet the agent of `run` in `env`, or to be compared with it there.

    Args:
        name: a run's folder or checkpoint, or a pretrained agent; or what needs no weights: an
            import path, one of `BOTS`, or `bot`, which is the run's `opponents.bot_class`, or else
            the environment's own bot.
        trust: import what a run that another user made names.

    Raises:
        UserError: if this player cannot play there.
    """
    if name == "bot":
        name = factory.config_of(run).opponents.bot_class or name
    if name in ("bot", *BOTS) or (":" in name and not Path(name).exists()):
        return Player(name, factory.make_bot(None if name == "bot" else name, env_settings, env))
    return load_player(folders.load_checkpoint(folders.find(name), trust, env.device), env, run)
