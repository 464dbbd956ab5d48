"""Makes Gymnasium's vector environments. Errors are one sentence with the likely cure."""

import contextlib
import difflib
import functools
import importlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from megastep import global_generators
from megastep.env_probe import probe
from megastep.imports import import_object, search_current_folder
from megastep.sync_envs import SyncEnvs, make_env
from megastep.vector_processes import VectorProcesses

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec
    from gymnasium.vector import VectorEnv

__all__ = ["vector_env"]

INSTALL = "pip install 'megastep-flatland[gymnasium]'"


def vector_env(
    id: str | None,
    n_envs: int,
    kwargs: Mapping[str, object],
    wrappers: Sequence[str],
    vectorization: str,
    restart_failed: int = 0,
    films: bool = False,
    seed: int = 1,
    check: bool = True,
) -> "VectorEnv | SyncEnvs | VectorProcesses":
    """Returns a vector environment. The step after an episode's end resets it.

    Args are those of :class:`~megastep.envs.gymnasium.env.Gymnasium`.

    Raises:
        ValueError: if it cannot be made, with the likely cure.
    """
    try:
        import gymnasium
    except ImportError:
        raise ValueError(f"Gymnasium is not installed: {INSTALL}") from None
    spec = _spec(id)
    try:
        functions = [import_object(name) for name in wrappers]
    except ValueError as error:
        raise ValueError(f"env.wrappers: {error}") from None
    try:
        if vectorization == "own":
            if restart_failed:
                raise ValueError(
                    "env.restart_failed makes single environments anew, which its own vector "
                    "environment has not; use env.vectorization=sync or async"
                )
            make_vec = functools.partial(gymnasium.make_vec, spec)
            return _checked(id, _own(make_vec, spec, functions, n_envs, kwargs))
        # a checker warns of what an environment does wrong in its first steps, once per environment
        settings = {"disable_env_checker": True, **kwargs}
        with global_generators.kept():
            example = make_env(spec, functions, settings)
        max_steps = example.unwrapped.spec and example.unwrapped.spec.max_episode_steps
        if films and "rgb_array" in (example.metadata.get("render_modes") or ()):
            settings = {"render_mode": "rgb_array", **settings}
        make_one = functools.partial(make_env, spec, functions, settings)
        with contextlib.suppress(Exception):
            example.close()
        make = functools.partial(
            SyncEnvs, make_one, restart_failed=restart_failed, seed=seed, check=check
        )
        if vectorization == "sync":
            vector = make(n_envs=n_envs, **probe(make_one)._asdict())
        else:  # a fault may end the process that it happens in
            vector = VectorProcesses(make, n_envs)
        vector.max_episode_steps = max_steps
        return vector
    except gymnasium.error.DependencyNotInstalled as error:
        raise ValueError(f"{id} needs a package that is missing: {_line(error)}") from None
    except ValueError as error:
        raise ValueError(f"{id} cannot be made: {_line(error)}") from None
    except Exception as error:
        cause = f" with env.kwargs={dict(kwargs)}" if kwargs else ""
        raise ValueError(
            f"{id} cannot be made{cause}: {type(error).__name__}: {_line(error)}"
        ) from error


def _spec(id) -> "EnvSpec":
    """Returns the specification of an environment, whose package is imported if it names one."""
    import gymnasium

    if id is None:
        raise ValueError("env.id is missing; name an environment, such as env.id=CartPole-v1")
    package, _, name = id.rpartition(":")
    if package:
        search_current_folder()
        try:
            importlib.import_module(package)
        except Exception as error:
            raise ValueError(
                f"env.id={id} needs the package {package}, which cannot be imported "
                f"({_line(error)}); install the one that has it"
            ) from None
    if name not in gymnasium.registry:
        near = difflib.get_close_matches(name, gymnasium.registry, 1)
        raise ValueError(
            f"Gymnasium has no environment {name!r}"
            + (f"; did you mean {near[0]}? " if near else ". ")
            + "Those of other packages are package:id, such as minigrid:MiniGrid-MemoryS7-v0"
        )
    return gymnasium.registry[name]


def _own(make, spec, wrappers, n_envs, kwargs) -> "VectorEnv":
    if wrappers:
        raise ValueError(
            "env.wrappers go around single environments, which its own vector environment has "
            "not; use env.vectorization=sync or async"
        )
    if spec.vector_entry_point is None:
        raise ValueError("it has no vector environment of its own; use env.vectorization=sync")
    return make(num_envs=n_envs, vectorization_mode="vector_entry_point", **kwargs)


def _checked(id: str | None, env: "VectorEnv") -> "VectorEnv":
    from gymnasium.vector import AutoresetMode

    mode = env.metadata.get("autoreset_mode")
    if mode != AutoresetMode.NEXT_STEP:
        env.close()
        raise ValueError(
            f"its own vector environment resets by {mode}, which loses the last observation of an "
            "episode or leaves the reset to others; use env.vectorization=sync"
        )
    return env


def _line(error) -> str:
    """Returns the first line of an error, without what Gymnasium adds to it."""
    line = (str(error).strip().splitlines() or [type(error).__name__])[0]
    return line.partition(" was raised from the environment creator")[0]
