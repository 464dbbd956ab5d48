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
from pathlib import Path
from typing import Literal

import pydantic
import yaml

import megastep
from megastep import cache
from megastep.agents import package
from megastep.imports import import_object
from megastep.settings import arguments_of, parameters_of

POLICY = "megastep.agents.networks.policy:Policy"
FILES = "megastep.geometries.sources:files"
MIXED = "megastep.geometries.sources:mixed"
CHECK_PARTS = "megastep.geometries.sources:check_parts"
SUITE = "megastep.geometries.sources:suite"
OPPONENTS = "megastep.agents.selfplay.opponents:Opponents"
LOGGERS = "megastep.agents.training.loggers"
#: How the arguments of a group's members become settings, as `arguments_of` takes it: `reserved`
#: are passed by the program, `missing` are defaults, and the others are settings beside them.
ARGUMENTS = {
    "env": dict(
        reserved=("geometries", "seed", "device", "privileged"), missing={"n_envs": 128}, name=str
    ),
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


def built_in() -> dict[tuple[str, str], tuple[str, dict[str, tuple]]]:
    """Returns what `arguments_of` returns of each component, by (group, import path)."""
    return cached()[0]


def takes_geometries(env: str) -> bool:
    """Returns whether the environment of an import path takes floor plans."""
    built_in, takers = cached()
    return env in takers if ("env", env) in built_in else _takes_geometries(env)


@functools.cache
def cached() -> tuple[dict[tuple[str, str], tuple[str, dict[str, tuple]]], set[str]]:
    """Returns what `read` does, from the cache on disk if no source has changed."""
    content, _ = cache.fetch(f"arguments-{_sources()}", lambda: pickle.dumps(read()))
    cache.prune("arguments-", VERSIONS)
    return pickle.loads(content)


def read() -> tuple[dict[tuple[str, str], tuple[str, dict[str, tuple]]], set[str]]:
    """Imports every component of megastep. Returns what `built_in` does, and the import paths of
    the environments that take floor plans.
    """
    names = [("agent", POLICY), ("opponents", OPPONENTS)]
    for group in ARGUMENTS:
        paths = members(group).values()
        names += [(group, path) for path in paths if path.startswith("megastep.")]
    names += [("logger", path) for path in _loggers()]
    arguments = {
        (group, name): arguments_of(import_object(name), **ARGUMENTS[group])
        for group, name in names
    }
    return arguments, {name for group, name in names if group == "env" and _takes_geometries(name)}


def _loggers():
    """Yields the import path of each logger: the class with the name of its file, in lower case."""
    package = importlib.import_module(LOGGERS)
    for file in pkgutil.iter_modules(package.__path__, f"{LOGGERS}."):
        for name, value in vars(importlib.import_module(file.name)).items():
            if inspect.isclass(value) and file.name == f"{LOGGERS}.{name.lower()}":
                yield f"{file.name}:{name}"


@functools.cache
def members(group: str) -> dict[str, str]:
    """Returns {member: its `name`} of the files of a group that name a component."""
    trees = {
        path.stem: yaml.safe_load(path.read_text()) or {}
        for path in sorted((package.CONFIGS / group).glob("*.yaml"))
    }
    trees = {member: tree.get(group, tree) for member, tree in trees.items()}
    return {member: tree["name"] for member, tree in trees.items() if "name" in tree}


def _takes_geometries(env):
    return "geometries" in parameters_of(import_object(env))


def _sources():
    """A hash of whatever decides how arguments are read and stored."""
    folders = Path(megastep.__file__).parent, package.CONFIGS.parent
    files = {path for folder in folders for path in folder.rglob("*.py")}
    files = sorted(files | {*package.CONFIGS.glob("*/*.yaml")})
    digest = hashlib.sha256(f"{sys.version} {pydantic.VERSION}".encode())
    for path in files:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:32]
