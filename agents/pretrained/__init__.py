"""Trained agents that come with megastep, and how to load them from Python.

    from megastep import geometries
    from megastep.agents import pretrained

    env = pretrained.make_env("pointgoal_anywhere", geometries.sample("maze", 16), n_envs=16)
    policy = pretrained.load("pointgoal_anywhere")
    world, state = env.reset(), policy.initial(16)
    for _ in range(500):
        decision, state = policy(world, state)
        world = env.step(decision)

Each agent is a file NAME.safetensors in this folder, with a card NAME.md beside it. On the command
line its name stands for a run: `evaluate.py run=NAME`.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from megastep.agents.errors import UserError
from megastep.agents.hardware import make_device
from megastep.agents.runs import folders, restore

if TYPE_CHECKING:
    from megastep.agents.networks.policy import Policy
    from megastep.types import Env

#: Where an agent's spaces are read from, which no floor plan changes. Keys needs doorways.
_HOMES, _N_HOMES = "megastep.geometries.sources:homes", 4


def names() -> list[str]:
    """Returns the names of the agents that come with megastep."""
    return [*folders.pretrained()]


def load(name: str, device: str = "auto") -> "Policy":
    """Returns a trained policy, ready to act: `decision, state = policy(world, state)`.

    It acts only: it has no critic, and its weights need no gradient. On a CPU this sets the number
    of threads that PyTorch uses, as training does.

    Args:
        name: one of `names()`; or the path of such a file, a run's folder or a checkpoint, or
            `latest`. A path comes first.
        device: `auto`, `cpu`, `cuda` or `cuda:1`; `auto` is a GPU if there is one.

    Raises:
        UserError: there is none; or it names modules outside megastep that you have not trained
            with here.
    """
    where = make_device(device)
    loaded = folders.load_checkpoint(folders.find(name), False, where)
    return restore.policy_of(loaded, device=where)


def _loaded(name, device) -> tuple:
    where = make_device(device)
    return where, folders.load_checkpoint(folders.find(name), False, where)


def load_with_env(name: str, device: str = "auto") -> "tuple[Policy, Env]":
    """Returns what `load` does, and a small environment that it acts in."""
    from megastep.agents import factory  # which a policy alone does not need
    from megastep.agents.factory import components

    where, loaded = _loaded(name, device)
    trained = factory.config_of(loaded)
    geometry = components.settings_for("geometry", _HOMES, n=_N_HOMES)
    homes = factory.homes(trained.env, geometry, "test")
    env = factory.make_sample(trained.env, homes, seed=trained.seed, device=where)
    restore.load_wrappers(env, loaded)
    return restore.policy_of(loaded, env), env


def make_env(
    name: str,
    geometries: Sequence[dict] = (),
    n_envs: int = 128,
    seed: int = 1,
    device: str = "auto",
    **changes,
) -> Any:
    """Returns an environment with the settings that an agent was trained with, and with what
    wrappers had learnt then.

    Args:
        name, device: as for `load`.
        geometries: floor plans, such as `geometries.sample("homes", 64, "test")`, of an environment
            that takes any.
        n_envs: number of environments.
        seed: of the environment.
        changes: other settings of the environment, such as `resample=False`.

    Raises:
        UserError: as `load`; or the environment has no such setting, or refuses its value.
    """
    from megastep.agents import factory
    from megastep.agents.factory import settings

    where, loaded = _loaded(name, device)
    trained = factory.config_of(loaded).env
    if unknown := [key for key in changes if not hasattr(trained, key)]:
        raise UserError(
            f"{settings.env_name(trained)} has no setting {unknown[0]}; it has "
            f"{', '.join(key for key in vars(trained) if key != 'name')}"
        )
    env = settings.changed(trained, n_envs=n_envs, **changes)
    made = factory.construct(env, geometries=[*geometries], seed=seed, device=where)
    restore.load_wrappers(made, loaded)
    return made
