"""Blocks of configuration files: what differs by the device and by the learner.

    learner:
      gamma: 0.99
    cpu:                 # laid over this file on a CPU
      learner:
        gamma: 0.98

A block is merged as Hydra loads its file, so that a later file wins over the blocks of an earlier
one. A learner of a user has the blocks of the built-in learner that it derives from, if of any.
"""

import functools
import os
from collections.abc import Callable
from contextlib import suppress
from types import NoneType
from typing import TYPE_CHECKING, Any, cast

from hydra.core import plugins
from hydra.plugins.config_source import ConfigSource
from omegaconf import DictConfig, OmegaConf

from megastep.agents.cli import config_files
from megastep.agents.factory import check, components, settings
from megastep.agents.launch import gpu
from megastep.imports import import_object

if TYPE_CHECKING:
    from hydra.plugins.config_source import ConfigResult

#: The names of blocks, the last of which wins, and whether they are laid over their files.
applied: dict[str, bool] = {}


def apply(device: object, learner: object) -> None:
    """Has Hydra lay the blocks of a device, and of a learner as `built_in` takes it, over the files
    that it loads from here on. Values of other types are told when the settings are checked.
    """
    is_cpu = device == "cpu" or (device == "auto" and not gpu.is_available())
    name = built_in(str(learner))
    learners = {one: one == name for one in components.members("learner")}
    applied.clear()
    applied.update({"cpu": is_cpu, "gpu": not is_cpu, **learners})


def built_in(learner: str) -> str | None:
    """Returns the name of the built-in learner whose blocks a learner has, from its name or import
    path; None if it has none.
    """
    names = {path: name for name, path in components.members("learner").items()}
    paths = [learner]
    if ":" in learner and learner not in names:
        with suppress(ValueError):  # which is told when the settings are checked
            bases = getattr(import_object(learner), "__mro__", ())
            paths = [f"{base.__module__}:{base.__qualname__}" for base in bases]
    known = [names[path] for path in paths if path in names]
    return learner if learner in names.values() else next(iter(known), None)


def merged(tree: check.Tree) -> check.Tree:
    """Returns what a file holds with its blocks merged into it."""
    blocks = [name for name in applied if isinstance(tree.get(name, False), (dict, NoneType))]
    content = {key: value for key, value in tree.items() if key not in blocks}
    layers = [merged(tree[name] or {}) for name in blocks if applied[name]]
    for layer in layers:
        content = _laid(content, layer)
    return content


def fit(config: DictConfig, learner: str | None) -> None:
    """Takes what only built-in learners have from the settings of a user's learner, which has the
    file of one.

    Args:
        learner: import path, None for `config.learner.name`.
    """
    if own := _fields(learner or OmegaConf.select(config, "learner.name")):
        built_in = components.built_in().items()
        ours = {key for (group, _), (_, keys) in built_in if group == "learner" for key in keys}
        for key in ours & {*config.learner} - {*own}:
            del config.learner[key]


def note(config: DictConfig, typed: list[str]) -> str:
    """Returns a sentence on what a user's learner has from files; "" if it has nothing."""
    name = OmegaConf.select(config, "learner.name")
    values = check.leaves(plain(config.learner)) if _fields(name) else ()
    typed = [*typed, "learner.name"]
    taken = [f"{key}={value}" for key, value in values if f"learner.{key}" not in typed]
    if not taken:
        return ""
    sources, base = [], built_in(name)
    if base:
        sources.append(f"{'the CPU' * applied['cpu'] or 'the'} values of {base}")
    if recipe := config.hydra.runtime.choices.get("experiment"):
        sources.append(f"experiment={recipe}")
    sources = " and ".join(sources) or "configuration files"
    return f"learner={name} takes {', '.join(taken)} from {sources}"


def plain(config: DictConfig, resolve: bool = False) -> check.Tree:
    """Returns a configuration as nested dicts."""
    return cast(check.Tree, OmegaConf.to_container(config, resolve=resolve))


def _fields(learner) -> dict | None:
    # of the settings of a user's learner; None if it is built in, or cannot be used, which is told
    # when the settings are checked
    if isinstance(learner, str) and ("learner", learner) not in components.built_in():
        with suppress(ValueError):
            return settings.kind_of("learner", learner).__pydantic_fields__


def _laid(below, above) -> Any:
    # one value over another: nested dicts key by key
    if not (isinstance(below, dict) and isinstance(above, dict)):
        return above
    return below | {key: _laid(below.get(key), value) for key, value in above.items()}


def _with_blocks(load_config) -> Callable:
    @functools.wraps(load_config)
    def load(source, config_path) -> "ConfigResult":
        if source.scheme() == "file":
            path = os.path.join(source.path, f"{config_path.removesuffix('.yaml')}.yaml")
            if os.path.exists(path):  # Hydra tells of those that do not
                config_files.check(path)
        result = load_config(source, config_path)
        if OmegaConf.is_dict(result.config) and any(name in result.config for name in applied):
            result.config = OmegaConf.create(merged(plain(result.config)))
        return result

    return load


for _source in cast("list[type[ConfigSource]]", plugins.Plugins.instance().discover(ConfigSource)):
    _source.load_config = _with_blocks(_source.load_config)
