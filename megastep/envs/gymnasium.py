"""Gymnasium: N copies of any environment of Gymnasium, one agent each, so B = N lanes.

They step on the CPU, even if the learner is on a GPU.
"""

import contextlib
import difflib
import functools
import importlib
from typing import TYPE_CHECKING, Annotated, Any, Literal

import torch
from pydantic import Field

from megastep import global_generators
from megastep.hosting.env_error import one_line
from megastep.hosting.vectorized import VectorizedEnv, one_sentence
from megastep.imports import import_object, search_current_folder
from megastep.settings import checked

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec

__all__ = ["Gymnasium"]

INSTALL = "pip install 'megastep-flatland[gymnasium]'"
#: Environments that step on the host are counted in hundreds; more is a typing error.
MAX_ENVS = 2**16


class Gymnasium(VectorizedEnv):
    """Any environment of Gymnasium, or of a package that registers its own with it.

    They step on the CPU: one after the other in this process (sync), or in worker processes, one
    per core (async). With a learner on a GPU, observations cross through pinned memory.
    docs/other-environments.md says what becomes of spaces, episodes and the numbers in ``info``.

    Args:
        n_envs: number of environments, N.
        id: name of the environment, such as CartPole-v1; with a colon, ``package:Name-v0``, of a
            package that is imported first.
        kwargs: arguments of the environment's constructor.
        wrappers: import paths of Gymnasium's wrappers, ``package.module:Wrapper``, put around every
            environment in this order.
        vectorization: how environments are stepped: sync, one after the other in this process;
            async, divided among processes, one per core.
        seed: each environment is reset with a seed of its own, which derives from this one.
        films: renders images from the start, if it can. Some environments make their renderer in
            the constructor, and some step more slowly with it.
        check: refuses, in the first steps, observations that are not in their space, and at any
            time actions that are not finite. Numbers beyond the bounds of a Box are a warning.
        device: where worlds and actions are. Default: a GPU if there is one.
    """

    @checked
    def __init__(
        self,
        n_envs: Annotated[int, Field(ge=1, le=MAX_ENVS)] = 32,
        *,
        id: str | None = None,
        kwargs: dict[str, Any] | None = None,
        wrappers: tuple[str, ...] = (),
        vectorization: Literal["sync", "async"] = "sync",
        seed: int = 1,
        films: bool = False,
        check: bool = True,
        device: torch.device | str | None = None,
    ):
        spec, kwargs = _spec(id), kwargs or {}
        try:
            functions = [import_object(name) for name in wrappers]
        except ValueError as error:
            raise ValueError(f"env.wrappers: {error}") from None
        with one_sentence(id, kwargs):
            vector = _hosted(spec, n_envs, kwargs, functions, vectorization, films, seed)
        super().__init__(id, vector, n_envs, 1, seed, device, check)


def _spec(id) -> "EnvSpec":
    """Returns the specification of an environment, whose package is imported if it names one."""
    try:
        import gymnasium
    except ImportError:
        raise ValueError(f"Gymnasium is not installed: {INSTALL}") from None
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
                f"({one_line(error)}); install the one that has it"
            ) from None
    if name not in gymnasium.registry:
        near = difflib.get_close_matches(name, gymnasium.registry, 1)
        raise ValueError(
            f"Gymnasium has no environment {name!r}"
            + (f"; did you mean {near[0]}? " if near else ". ")
            + "Those of other packages are package:id, such as minigrid:MiniGrid-MemoryS7-v0"
        )
    return gymnasium.registry[name]


def _hosted(spec, n_envs, kwargs, wrappers, vectorization, films, seed) -> Any:
    """Returns single environments as a vector environment, in this process or in others."""
    from megastep.hosting.hosted import HostedEnvs, make_env
    from megastep.hosting.probe import probe
    from megastep.hosting.processes import VectorProcesses

    # Gymnasium's checker warns of an environment's faults once per environment
    kwargs = {"disable_env_checker": True, **kwargs}
    with global_generators.kept():
        example = make_env(spec, wrappers, kwargs)
    if films and "rgb_array" in (example.metadata.get("render_modes") or ()):
        kwargs = {"render_mode": "rgb_array", **kwargs}
    with contextlib.suppress(Exception):
        example.close()
    make = functools.partial(make_env, spec, wrappers, kwargs)
    if vectorization == "sync":
        vector = HostedEnvs(make, n_envs, found=probe(make), seed=seed)
    else:
        vector = VectorProcesses(make, n_envs, seed)
    vector.max_episode_steps = kwargs.get("max_episode_steps", spec.max_episode_steps)
    return vector
