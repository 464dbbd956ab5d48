"""The words of a command line -> Hydra -> checked settings, before anything is written.

Only Hydra's public API is used: its grammar reads the words, `hydra.compose` composes the groups,
and keys are set in what comes out, so that every error has its own word. Jobs of sweeps compose in
the same way, in whichever process they run.
"""

import copy
import dataclasses
import functools
import os
import re
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

import hydra
import torch
from hydra.core import config_store, global_hydra, plugins
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, MissingConfigException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from megastep.agents.cli.check import CONFIGS, check, closest_key
from megastep.agents.cli.program import (
    DISTRIBUTION,
    ConfigErrors,
    UserError,
    first_line,
    shortened,
)
from megastep.agents.cli.settings import GROUPS
from megastep.settings import closest

Tree = dict[str, Any]
#: The longest key and member of a group, and the most brackets of a word: Python's recursion ends
#: not far above.
LONGEST, MOST_BRACKETS = 200, 40
#: An element of a value with = in it, as folders of sweeps have, and what quotes it.
WITH_EQUALS, QUOTED = re.compile(r"[^\[\],]*=[^\[\],]*"), r'"\g<0>"'
#: Members of Hydra's own groups that come with the optional dependencies.
EXTRAS = ("joblib", "optuna", "submitit_local", "submitit_slurm")
#: Groups with keys that no file has: the arguments of constructors.
OPEN = ("env", "geometry", "agent", "learner", "opponents", "logger")

config_store.ConfigStore.instance().store(
    name="open",
    node=OmegaConf.create({key: OmegaConf.create({}, flags={"struct": False}) for key in OPEN}),
)


@dataclasses.dataclass(frozen=True)
class Script:
    """One of the programs: train, evaluate, record.

    Args:
        name: the file of its configuration.
        kind: the dataclass of its settings.
        run: does the work, given settings.
        help: the head of `--help`.
        prepare: changes the composed tree before it is checked, given the typed keys.
    """

    name: str
    kind: type
    run: Callable[[Any], Any]
    help: str
    prepare: Callable[[Tree, list[str]], Tree] = lambda tree, typed: tree


class FolderOfUser(SearchPathPlugin):
    """Has Hydra find files and groups in the folder given by `--config-dir`, beside ours."""

    path: str | None = None

    def manipulate_search_path(self, search_path):
        if self.path:
            search_path.append("command-line", f"file://{self.path}")


class Composer:
    """Composes and checks the configuration of one script.

    Args:
        script: whose settings they are.
        name: another file than the script's own.
        folder: a folder whose files and groups are found beside ours.
        main: a folder in place of ours.
    """

    def __init__(
        self, script: Script, name: str | None = None, folder: str | None = None, main: Any = None
    ):
        self.script, self.name, self.folder = script, name or script.name, folder
        self.main = os.path.abspath(main or CONFIGS)
        for path in filter(None, (folder, self.main)):
            if not os.path.isdir(path):
                raise UserError(f"There is no folder {path} with configurations")
        FolderOfUser.path = folder and os.path.abspath(folder)
        plugins.Plugins.instance().register(FolderOfUser)
        global_hydra.GlobalHydra.instance().clear()
        hydra.initialize_config_dir(self.main, job_name=script.name, version_base="1.3")
        self.loader = global_hydra.GlobalHydra.instance().config_loader()
        self.members = functools.cache(self.loader.get_group_options)
        self.composed = functools.cache(self._composed)

    def groups(self) -> dict[str, list[str]]:
        """Returns {group: members} of the groups to choose from."""
        names = [group for group in self.composed().hydra.runtime.choices if "/" not in group]
        names += [name for name in self.loader.list_groups("") if self.folder and name not in names]
        members = {name: [m for m in self.members(name) if ":" not in m] for name in names}
        return {name: members[name] for name in names if members[name] and name != "hydra"}

    def parse(self, words: Iterable[str]) -> list[Override]:
        """Returns words as Hydra's grammar reads them. Raises ConfigErrors naming all unreadable
        ones.
        """
        overrides, errors, parser = [], [], OverridesParser.create(self.loader)
        for word in words:
            key, _, value = word.partition("=")
            fits = len(key) <= LONGEST and value.count("[") + value.count("{") <= MOST_BRACKETS
            for text in (word, f"{key}={WITH_EQUALS.sub(QUOTED, value)}") if key and fits else ():
                with suppress(HydraException, ValueError):
                    overrides.append(parser.parse_override(text))
                    break
            else:
                cure = "write key=value, and quote blanks and brackets: 'key=\"a b\"'"
                errors.append((shortened(word), f"cannot be read; {cure}"))
        if errors:
            raise ConfigErrors(errors)
        return overrides

    def compose(self, words: Iterable[str]) -> tuple[Any, DictConfig]:
        """Returns checked settings, and the configuration they are from, Hydra's part included.
        Raises ConfigErrors with everything that is wrong.
        """
        overrides = self.parse(words)
        config, errors = self.config(overrides)
        try:
            settings = self._checked(config, [key_of(one) for one in overrides])
        except ConfigErrors as error:
            errors += error.errors
        if errors:
            raise ConfigErrors(errors)
        return settings, config

    def settings(self, words: Iterable[str]) -> Any:
        """Returns checked settings."""
        return self.compose(words)[0]

    def config(self, overrides: list[Override]) -> tuple[DictConfig, list[tuple[str, str]]]:
        """Returns (the configuration, the errors of words that are not in it)."""
        groups, keys, errors = [], {}, []
        for one in overrides:
            if one.is_sweep_override():
                cure = "has several values; add -m for a sweep"
                errors.append((key_of(one), f"{one.input_line!r} {cure}"))
            elif not self.members(one.key_or_group) or isinstance(one.value(), dict):
                keys[key_of(one)] = one
            elif error := self._member_error(one.key_or_group, one.value()):
                errors.append((key_of(one), error))
            else:
                groups.append(one.input_line)
        if "hydra.searchpath" in keys:
            groups.append(keys.pop("hydra.searchpath").input_line)
        device = keys["device"].value() if "device" in keys else None
        try:
            config = copy.deepcopy(self.composed(*groups, device=device))
        except MissingConfigException as error:
            cure = "is in none of the folders searched; --config-dir adds one"
            raise ConfigErrors([(error.missing_cfg_file or self.name, cure)]) from None
        except (HydraException, OmegaConfBaseException) as error:
            raise ConfigErrors([*errors, ("configuration", shortened(error, 400))]) from None
        for key, one in keys.items():
            try:
                _apply(one, key, config)
            except (ConfigKeyError, ConfigAttributeError):
                names = [name for name, _ in leaves({"hydra": plain(config.hydra)})]
                errors.append((key, f"no such key; {closest_key(key, names)}"))
            except OmegaConfBaseException as error:
                errors.append((key, first_line(error)))
        return config, errors

    def _composed(self, *groups: str, device: str | None = None) -> DictConfig:
        """Returns what Hydra composes; `preset=auto` stands for gpu or cpu, by the device."""
        config = hydra.compose(self.name, [*groups], return_hydra_config=True)
        if config.hydra.runtime.choices.get("preset") == "auto":
            preset = "preset=gpu" if has_gpu(device or config.get("device")) else "preset=cpu"
            config = hydra.compose(self.name, [*groups, preset], return_hydra_config=True)
        OmegaConf.set_struct(config, False)
        return config

    def _member_error(self, group: str, member: Any) -> str | None:
        """Returns what is wrong with a member of a group; tells Hydra of an import path."""
        options, is_path = self.members(group), ":" in str(member) and len(str(member)) <= LONGEST
        if member is None or member in options:
            return None
        if is_path and group in GROUPS and not GROUPS[group].kinds:
            return config_store.ConfigStore.instance().store(group=group, name=member, node={"name": member})
        if member in EXTRAS:
            return f"{member} is not installed: pip install '{DISTRIBUTION}[sweep]'"
        return f"{member!r} is unknown; {closest(member, options)}"

    def _checked(self, config: DictConfig, typed: list[str]) -> Any:
        cure = "is an environment variable, and would be written to config.yaml; type the value"
        if secret := [key for key, value in leaves(own(config)) if "${oc.env:" in str(value)]:
            raise ConfigErrors((key, cure) for key in secret)
        try:
            tree = own(config, resolve=True)
        except OmegaConfBaseException as error:
            raise ConfigErrors([(error.full_key or "configuration", first_line(error))]) from None
        tree = self.script.prepare(tree, [key for key in typed if not key.startswith("hydra")])
        groups = self.loader.list_groups("") + [f"hydra/{g}" for g in self.loader.list_groups("hydra")]
        return check(self.script.kind, tree, groups)

    def call_hydra(
        self, arguments: list[str], task: Callable | None = None, name: str | None = None
    ) -> None:
        """Calls Hydra's own main with these arguments. Its errors are raised; it sets sys.argv."""
        os.environ["HYDRA_FULL_ERROR"] = "1"
        sys.argv = [sys.argv[0], *arguments]
        global_hydra.GlobalHydra.instance().clear()
        main = hydra.main(config_path=self.main, config_name=name or self.name, version_base="1.3")
        main(task or self.script.run)()


def has_gpu(device: object) -> bool:
    """Returns whether a run on `device` would use a GPU of this machine."""
    return device != "cpu" and torch.cuda.is_available()


def key_of(override: Override) -> str:
    """Returns the key or group@package of a word, without the sign before it."""
    return override.get_key_element().lstrip("+~")


def own(config: DictConfig, resolve: bool = False) -> Tree:
    """Returns nested dicts of all but Hydra's part, without groups that nothing is in."""
    tree = plain(OmegaConf.masked_copy(config, [key for key in config if key != "hydra"]), resolve)
    return {key: value for key, value in tree.items() if value != {}}


def plain(config: DictConfig, resolve: bool = False) -> Tree:
    return OmegaConf.to_container(config, resolve=resolve)


def leaves(tree: Tree, prefix: str = "") -> list[tuple[str, Any]]:
    """Returns [(dotted key, value)] of nested dicts."""
    pairs = []
    for key, value in tree.items():
        nested = isinstance(value, dict)
        pairs += leaves(value, f"{prefix}{key}.") if nested else [(f"{prefix}{key}", value)]
    return pairs


def _apply(override: Override, key: str, config: DictConfig) -> None:
    """Sets or deletes a key in a configuration. Raises OmegaConfBaseException."""
    if override.is_delete():
        parent, _, leaf = key.rpartition(".")
        del (OmegaConf.select(config, parent) if parent else config)[leaf]
    else:
        force_add = override.is_add() or override.is_force_add() or not key.startswith("hydra.")
        OmegaConf.update(config, key, override.value(), force_add=force_add)
