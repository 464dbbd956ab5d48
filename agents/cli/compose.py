"""Command line -> Hydra -> checked settings. Everything is composed and checked before anything is
written.

Hydra's own parts do the work, but for `@hydra.main`: it would make its folder first, and exit 1.
"""

import copy
import dataclasses
import os
from collections.abc import Callable, Iterable
from typing import Any

from hydra import version
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from megastep.agents.cli import overrides as words_of
from megastep.agents.cli.build import as_tree, build, keys_of
from megastep.agents.cli.errors import ConfigErrors, UserError
from megastep.agents.cli.loader import Loader, hydra_error, maximise
from megastep.agents.cli.registry import CONFIGS

Tree = dict[str, Any]
#: Changes a composed tree before it is checked, given the keys that were typed.
Prepare = Callable[[Tree, list[str]], Tree]
#: What reads the environment of the process.
FROM_ENVIRONMENT = "${oc.env:"


def as_is(tree: Tree, given: list[str]) -> Tree:
    return tree


@dataclasses.dataclass(frozen=True)
class Check:
    """Makes settings of a composed configuration: those of dataclass `kind`. `prepare` may change
    what was composed; `groups` are names that may have been meant beside those of keys.
    """

    kind: type
    prepare: Prepare = as_is
    groups: tuple[str, ...] = ()

    def __call__(self, config: DictConfig, words: Iterable[str]) -> Any:
        """Settings, given the words that were typed. ConfigErrors with all that is wrong."""
        given = [words_of.key_of(one) for one in words_of.parse(words)]
        given = [key for key in given if key.partition("/")[0].partition(".")[0] != "hydra"]
        raw = plain(config, resolve=False)
        if secret := [key for key, value in leaves(raw) if FROM_ENVIRONMENT in str(value)]:
            cure = "would be written to config.yaml; give the value itself"
            raise ConfigErrors((key, f"what the environment holds {cure}") for key in secret)
        return build(self.kind, self.prepare(plain(config), given), self.groups)


class ConfigLoader:
    """Composes and checks the configuration of one script; a context, as Hydra keeps its state in
    globals.

    Args: `script`, the name of its own file; `kind`, the dataclass of its settings; `prepare`, what
    may change a tree before it is checked; `name`, another file than its own; `folder`, whose files
    and groups are found beside ours; `main`, a folder in place of ours.
    """

    def __init__(
        self,
        script: str,
        kind: type,
        prepare: Prepare = as_is,
        name: str | None = None,
        folder: str | None = None,
        main: str | None = None,
    ):
        self.script, self.kind, self.prepare = script, kind, prepare
        self.name, self.folders = name or script, (main or str(CONFIGS), folder)

    def __enter__(self):
        for folder in self.folders:
            if folder is not None and not os.path.isdir(folder):
                raise UserError(f"There is no folder {folder} with configurations")
        self._clear()
        version.setbase("1.3")
        main, folder = self.folders
        search_path = create_config_search_path(f"file://{os.path.abspath(main)}")
        if folder is not None:
            search_path.prepend(
                "command-line", f"file://{os.path.abspath(folder)}", SearchPathQuery("schema")
            )
        maximise()
        self.loader = Loader(search_path)
        self.hydra = Hydra(self.script, self.loader)
        GlobalHydra.instance().initialize(self.hydra)
        self.check = Check(self.kind, self.prepare, tuple(self.loader.list_groups("")))
        return self

    def __exit__(self, *error):
        self._clear()

    @staticmethod
    def _clear():
        GlobalHydra.instance().clear()
        HydraConfig.instance().cfg = None

    def groups(self) -> dict[str, list[str]]:
        """{group: [members]}: those that the script's own file has a default for, and those of the
        user's folder.
        """
        found = self.loader.compute_defaults_list(self.name, [], RunMode.RUN)
        own = [group for group in found.overrides.known_choices if "/" not in group]
        if folder := self.folders[1]:
            own += [
                name for name in self.loader.list_groups("") if os.path.isdir(f"{folder}/{name}")
            ]
        members = {group: self.loader.members(group, self.name) for group in dict.fromkeys(own)}
        return {
            group: [member for member in found if ":" not in member]
            for group, found in members.items()
            if found and group != "hydra"
        }

    def compose(self, words: list[str], mode: RunMode = RunMode.RUN) -> DictConfig:
        """The configuration as Hydra composes it, its own part included. ConfigErrors names all
        words that it could not be given.
        """
        try:
            config = self.hydra.compose_config(self.name, words, mode)
        except (HydraException, OmegaConfBaseException) as error:
            raise ConfigErrors([hydra_error(error, self._hydras(words))]) from None
        HydraConfig.instance().set_config(config)
        return config

    def settings(self, words: list[str]) -> Any:
        """Checked settings for one list of overrides. ConfigErrors names every unknown key and
        group member, and every bad value.
        """
        return self.composed(words)[0]

    def composed(self, words: list[str], known: dict | None = None) -> tuple[Any, DictConfig]:
        """Checked settings, and the configuration that they are from. Where `known` is given, it
        keeps what was composed of the same groups, as each time takes 0.2 s.
        """
        good, errors = self.loader.translated(words, self.name, RunMode.RUN)
        try:
            config = self.compose(good) if known is None else self._derived(good, known)
            settings = self.check(config, words)
        except ConfigErrors as error:
            raise ConfigErrors([*errors, *error.errors]) from None
        except (HydraException, OmegaConfBaseException) as error:
            raise ConfigErrors([*errors, hydra_error(error, None)]) from None
        if errors:
            raise ConfigErrors(errors)
        return settings, config

    def _derived(self, words, known):
        """What words compose to, from the composition of their groups alone."""
        keys = [word for word in words if word.startswith("++") and word[:9] != "++device="]
        groups = tuple(word for word in words if word not in keys)
        if groups not in known:
            known[groups] = self.compose([*groups])
        config = copy.deepcopy(known[groups])
        Loader._apply_overrides_to_config(words_of.parse(keys), config)
        return config

    def tree(self, words: list[str]) -> Tree:
        """Nested dicts for one list of overrides, every setting in them; errors as `settings`."""
        return as_tree(self.settings(words))

    def jobs(self, words: list[str]) -> list[tuple[list[str], Tree]]:
        """The tree of each job of a sweep that can be told beforehand, `[(overrides, nested
        dicts)]`: all of them, or those at its bounds if the sweeper searches.
        """
        master = self.compose(words, RunMode.MULTIRUN)
        is_grid = str(master.hydra.sweeper.get("_target_")).endswith(".BasicSweeper")
        params = OmegaConf.select(master, "hydra.sweeper.params") or {}
        words = [*(f"{key}={value}" for key, value in params.items()), *words]
        try:
            parsed = words_of.parse(words, self.loader, multirun=True)
            if is_grid and (wide := [one for one in parsed if one.is_interval_sweep()]):
                cure = "needs a sweeper that searches, such as hydra/sweeper=optuna"
                raise ConfigErrors((words_of.key_of(one), f"interval() {cure}") for one in wide)
            found = list(words_of.combinations(parsed, is_grid))
        except HydraException as error:
            raise UserError(f"This sweep cannot be split: {error}") from None
        known = {}
        return [(job, as_tree(self.composed(job, known)[0])) for job in found]

    def printed(self, words: list[str], what: str, package: str | None, resolve: bool) -> str:
        """The configuration as YAML: of the `job`, of `hydra`, or `all`; or a part of it."""
        settings, config = self.composed(words)
        own, tree = plain(config, resolve=False), as_tree(settings)
        if not resolve:
            for key, value in leaves(own):
                if isinstance(value, str) and "${" in value:
                    _put(tree, key, value)
        whole = OmegaConf.create({} if what == "hydra" else tree)
        if what != "job":
            hydras = self.hydra.get_sanitized_hydra_cfg(config)
            whole.hydra = OmegaConf.to_container(hydras.hydra, resolve=resolve)
        if package not in (None, "_global_"):
            found = OmegaConf.select(whole, package)
            if found is None:
                raise UserError(f"There is no {package} in the configuration")
            return str(found) if not OmegaConf.is_config(found) else OmegaConf.to_yaml(found)
        return OmegaConf.to_yaml(whole)

    def complete(self, words: list[str]) -> None:
        """Answers a shell that completes words, keys of constructors among them."""
        self.loader.keys = lambda config: keys_of(self.kind, plain(config, resolve=False))
        try:
            self.hydra.shell_completion(self.name, words)
        except ValueError as error:
            raise UserError(" ".join(str(error).split())) from None
        except ConfigErrors:
            pass  # there is nothing to complete after words that are wrong

    def _hydras(self, words):
        """Hydra's own settings, but for keys that were typed; None if they do not compose."""
        groups = [word for word in words if word.startswith("hydra/")]
        try:
            return self.hydra.compose_config(self.name, groups, RunMode.RUN).hydra
        except (HydraException, OmegaConfBaseException, ConfigErrors):
            return None


def plain(config: DictConfig, resolve: bool = True) -> Tree:
    """Nested dicts of all but Hydra's own part."""
    own = OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])
    return OmegaConf.to_container(own, resolve=resolve)


def leaves(tree: Tree, path: str = "") -> list[tuple[str, Any]]:
    """[(dotted key, value)]"""
    found = []
    for key, value in tree.items():
        if isinstance(value, dict):
            found += leaves(value, f"{path}{key}.")
        else:
            found.append((f"{path}{key}", value))
    return found


def _put(tree, key, value):
    *groups, last = key.split(".")
    for group in groups:
        tree = tree[group]
    tree[last] = value
