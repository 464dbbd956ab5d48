"""The arguments of the components of megastep, known without importing them.

Settings are arguments of constructors, whose modules import PyTorch: that takes seconds, in which a
typing error should long have been named. So all arguments are read once and cached on disk under a
hash of the sources.
"""

import functools
import hashlib
import importlib
import inspect
import pickle
import pkgutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import pydantic
import yaml
from pydantic import BeforeValidator

import megastep
from megastep import cache
from megastep.agents import package
from megastep.imports import import_object
from megastep.settings import arguments_of, parameters_of


def _wrappers(value: object) -> object:
    """Checks names and settings of wrappers. Raises ValueError naming what is wrong."""
    return import_object("megastep.agents.factory.settings:checked_wrappers")(value)


POLICY = "megastep.agents.networks.policy:Policy"
#: Floor plans unless geometry= says otherwise.
HOMES = "megastep.geometries.sources:homes"
FILES = "megastep.geometries.sources:files"
MIXED = "megastep.geometries.sources:mixed"
CHECK_PARTS = "megastep.geometries.sources:check_parts"
SUITE = "megastep.geometries.sources:suite"
OPPONENTS = "megastep.agents.selfplay.opponents:Opponents"
#: Where components are found without a file in configs/.
ENVS, SOURCES = "megastep.envs", "megastep.geometries.sources"
WRAPPERS = "megastep.wrappers"
LEARNERS, LOGGERS = "megastep.agents.algorithms", "megastep.agents.training.loggers"
#: How the arguments of a group's members become settings, as `arguments_of` takes it: `reserved`
#: are passed by megastep, `missing` are defaults, and the others are settings beside them.
ARGUMENTS = {
    "env": dict(
        # wrappers of a package are the environment's own argument, those of megastep are not
        reserved=("geometries", "seed", "device", "privileged", "films", "wrappers"),
        missing={"n_envs": 128},
        name=str,
        wrappers=(Annotated[tuple, BeforeValidator(_wrappers)], ()),
    ),
    "wrapper": dict(reserved=("env", "seed"), name=str),
    "geometry": dict(reserved=("split",), missing={"n": 512, "seed": 1}, name=str),
    "learner": dict(
        reserved=("policy", "seed", "graph"),
        name=str,
        # what lr falls to 0 over; auto: samples if given, else seconds if given
        anneal=(Literal["auto", "never", "samples", "seconds"], "auto"),
    ),
    "curriculum": dict(reserved=("env", "learner", "rollout", "sources"), name=str),
    "logger": dict(reserved=("folder", "step", "run_name", "config"), name=str),
    "agent": dict(reserved=("obs_space", "action_space", "privileged_space", "seed")),
    "opponents": dict(
        reserved=("env", "policy", "scripted", "seed"),
        bot_class=(str | None, None),  # None: the environment's own
    ),
}
#: Number of versions of the sources whose arguments stay in the cache.
VERSIONS = 8


class Components(NamedTuple):
    """The components of megastep.

    Attributes:
        arguments: what `arguments_of` returns of each, by (group, import path).
        takers: import paths of the environments that take floor plans.
        members: {group: {name: import path}} of those that need no file in configs/.
    """

    arguments: dict[tuple[str, str], tuple[str, dict[str, tuple]]]
    takers: set[str]
    members: dict[str, dict[str, str]]


def built_in() -> dict[tuple[str, str], tuple[str, dict[str, tuple]]]:
    """Returns what `arguments_of` returns of each component, by (group, import path)."""
    return cached().arguments


def takes_geometries(env: str) -> bool:
    """Returns whether the environment of an import path takes floor plans."""
    return env in cached().takers if ("env", env) in built_in() else _takes_geometries(env)


def members(group: str) -> dict[str, str]:
    """Returns {member: its `name`} of a group's components, with a file in configs/ or without."""
    return cached().members.get(group, {}) | _files(group)


@functools.cache
def cached() -> Components:
    """Returns what `read` does, from the cache on disk if no source has changed."""
    content, _ = cache.fetch(f"arguments-{_sources()}", lambda: pickle.dumps(tuple(read())))
    cache.prune("arguments-", VERSIONS)
    return Components(*pickle.loads(content))


def read() -> Components:
    """Imports every component of megastep."""
    envs, sources, wrappers = map(importlib.import_module, (ENVS, SOURCES, WRAPPERS))
    found = {
        "env": {name: f"{ENVS}.{name}:{kind.__name__}" for name, kind in envs.ENVS.items()},
        "geometry": {name: f"{SOURCES}:{name}" for name in sources.__all__},
        "learner": {k: v for k, v in _classes(LEARNERS) if hasattr(import_object(v), "collector")},
        "logger": dict(_classes(LOGGERS)),
        "wrapper": {
            name: f"{WRAPPERS}:{kind.__name__}" for name, kind in wrappers.WRAPPERS.items()
        },
    }
    names = [("agent", POLICY), ("opponents", OPPONENTS)]
    for group in ARGUMENTS:
        paths = {*found.get(group, {}).values(), *_files(group).values()}
        names += [(group, path) for path in paths if path.startswith("megastep.")]
    arguments = {
        (group, name): arguments_of(import_object(name), **ARGUMENTS[group])
        for group, name in names
    }
    takers = {name for group, name in names if group == "env" and _takes_geometries(name)}
    return Components(arguments, takers, found)


def _classes(package: str) -> Iterator[tuple[str, str]]:
    """Yields (file, import path) of the classes that have the name of their file, in lower case."""
    for file in pkgutil.iter_modules(importlib.import_module(package).__path__):
        module = importlib.import_module(f"{package}.{file.name}")
        for name, value in vars(module).items():
            if inspect.isclass(value) and name.lower() == file.name:
                yield file.name, f"{package}.{file.name}:{name}"


@functools.cache
def _files(group: str) -> dict[str, str]:
    """Returns {member: its `name`} of the files of a group that name a component."""
    trees = {
        path.stem: yaml.safe_load(path.read_text()) or {}
        for path in sorted((package.CONFIGS / group).glob("*.yaml"))
    }
    trees = {member: tree.get(group, tree) for member, tree in trees.items()}
    return {member: tree["name"] for member, tree in trees.items() if "name" in tree}


def _takes_geometries(env) -> bool:
    return "geometries" in parameters_of(import_object(env))


def _sources() -> str:
    """A hash of whatever decides how arguments are read and stored."""
    folders = Path(megastep.__file__).parent, package.CONFIGS.parent
    files = {path for folder in folders for path in folder.rglob("*.py")}
    files = sorted(files | {*package.CONFIGS.glob("*/*.yaml")})
    digest = hashlib.sha256(f"{sys.version} {pydantic.VERSION}".encode())
    for path in files:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:32]
