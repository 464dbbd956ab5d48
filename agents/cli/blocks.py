"""Blocks of configuration files, such as `cpu:`: what differs by the device and by the learner.

A block is merged as Hydra reads its file, so a later file wins over the blocks of an earlier one.
"""

from collections.abc import Mapping
from contextlib import suppress
from types import NoneType
from typing import TYPE_CHECKING, ClassVar, cast

from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core import plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import Container, DictConfig, OmegaConf

from megastep.agents import package
from megastep.agents.factory import check, components
from megastep.agents.launch import gpu
from megastep.imports import import_object, import_path

if TYPE_CHECKING:
    from hydra.plugins.config_source import ConfigResult


class BlockSource(FileConfigSource):
    """Hydra's source of files, which merges the blocks that apply into them."""

    #: The names of blocks, the last of which wins, and whether they apply.
    blocks: ClassVar[dict[str, bool]] = {}

    @staticmethod
    def scheme() -> str:
        return "blocks"

    def load_config(self, config_path: str) -> "ConfigResult":
        result = super().load_config(config_path)
        if OmegaConf.is_dict(result.config) and any(name in result.config for name in self.blocks):
            result.config = OmegaConf.create(merged(plain(result.config), self.blocks))
        return result


class Folders(SearchPathPlugin):
    """Has Hydra read the files of our folder, and of --config-dir, with their blocks."""

    beside = ""

    def manipulate_search_path(self, search_path) -> None:
        for entry in search_path.get_path():
            if entry.path.removeprefix("file://") == str(package.CONFIGS):
                entry.path = f"blocks://{package.CONFIGS}"
                if self.beside:
                    search_path.append("command-line", f"blocks://{self.beside}")
                break


plugins.Plugins.instance().register(BlockSource)
plugins.Plugins.instance().register(Folders)


def blocks_of(device: object, learner: object) -> dict[str, bool]:
    """Returns the names of blocks, and whether they apply on a device and with a learner."""
    is_cpu = device == "cpu" or (device == "auto" and not gpu.is_available())
    own = built_in(str(learner))
    learners = {name: name == own for name in components.members("learner")}
    return {"cpu": is_cpu, "gpu": not is_cpu, **learners}


def built_in(learner: str) -> str | None:
    """Returns the name of the built-in learner whose blocks a learner has; None if it has none."""
    names = {path: name for name, path in components.members("learner").items()}
    if learner in names.values():
        return learner
    paths = [learner]
    if ":" in learner and learner not in names:
        with suppress(ValueError):  # which is an error when the settings are checked
            paths = [*map(import_path, getattr(import_object(learner), "__mro__", ()))]
    return next((names[path] for path in paths if path in names), None)


def merged(tree: check.Tree, blocks: Mapping[str, bool]) -> check.Tree:
    """Returns what a file holds with its blocks merged into it."""
    own = [name for name in blocks if isinstance(tree.get(name, False), (dict, NoneType))]
    content = {key: value for key, value in tree.items() if key not in own}
    layers = [merged(tree[name] or {}, blocks) for name in own if blocks[name]]
    return plain(cast(Container, OmegaConf.merge(content, *layers)))


def plain(config: Container, resolve: bool = False) -> check.Tree:
    """Returns a configuration as nested dicts."""
    return cast(check.Tree, OmegaConf.to_container(config, resolve=resolve))


def leave_out_others(config: DictConfig, learner: str | None) -> None:
    """Takes what only built-in learners have from the settings of a user's learner."""
    name = learner or OmegaConf.select(config, "learner.name")
    known = components.members("learner").values()
    if not isinstance(name, str) or name in known:
        return
    with suppress(ValueError):  # it cannot be used, which is an error when settings are checked
        own = components.kind_of("learner", name).__pydantic_fields__
        kinds = [components.kind_of("learner", path) for path in known]
        ours = {key for kind in kinds for key in kind.__pydantic_fields__}
        for key in ours & {*config.learner} - {*own}:
            del config.learner[key]
