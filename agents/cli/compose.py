"""The words of a command line, or keyword arguments -> Hydra -> checked settings."""

import copy
import functools
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from types import NoneType
from typing import TYPE_CHECKING, Any, ClassVar, cast

import hydra
import yaml
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core import config_store, global_hydra, plugins
from hydra.core.override_parser import types
from hydra.errors import HydraException, MissingConfigException
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import Container, DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from megastep.agents import package
from megastep.agents.cli.words import Typed, key_of, parse, typed_of, typed_word
from megastep.agents.errors import ConfigErrors, UserError, shortened
from megastep.agents.factory import check, components, conflicts
from megastep.agents.launch import gpu
from megastep.imports import import_object, import_path
from megastep.settings import closest

if TYPE_CHECKING:
    from megastep.agents.cli.command import Command

#: Members of Hydra's own groups that come with the optional dependencies.
EXTRAS = ("joblib", "optuna", "submitit_local", "submitit_slurm")
#: Groups with keys that no file has, for they are arguments of constructors.
OPEN = {
    key: OmegaConf.create({}, flags={"struct": False})
    for key in (*components.CHOSEN, *components.SINGLE)
}
MAIN = str(package.CONFIGS)
#: The learner whose blocks are tried first where none is typed.
GUESS = "ppo"
#: Resolvers that settings may call: none that reads what is not in the configuration.
RESOLVERS = ("now", "oc.dict.keys", "oc.dict.values", "oc.select", "python_version")
#: What Hydra raises for words that it cannot use.
HYDRA_ERRORS = (HydraException, OmegaConfBaseException, yaml.YAMLError, AssertionError)
#: What files of configurations raise beside these, where defaults are not a list or are circular.
FILE_ERRORS = (*HYDRA_ERRORS, ValueError, TypeError, LookupError, RecursionError)
STORE = config_store.ConfigStore.instance()
STORE.store(name="open", node=OmegaConf.create(OPEN))


# ---- Blocks of files, such as `cpu:`: what differs by the device and by the learner ----


class BlockSource(FileConfigSource):
    """Hydra's source of files, which merges the blocks that apply into each; a later file wins."""

    #: The names of blocks, the last of which wins, and whether they apply.
    blocks: ClassVar[dict[str, bool]] = {}

    @staticmethod
    def scheme() -> str:
        return "blocks"

    def load_config(self, config_path: str) -> ConfigResult:
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


# ---- Words ----


def own(config: DictConfig, resolve: bool = False) -> check.Tree:
    """Nested dicts of all but Hydra's part, without empty groups."""
    keys = [str(key) for key in config if key != "hydra"]
    tree = plain(OmegaConf.masked_copy(config, keys), resolve)
    return {key: value for key, value in tree.items() if value != {}}


def refused_resolvers(tree: check.Tree) -> Iterator[tuple[str, str]]:
    """Yields (key, sentence) of values that call a resolver which is not one of `RESOLVERS`."""
    for key, value in check.leaves(tree):
        for name in dict.fromkeys(re.findall(r"\$\{\s*([\w.]+)\s*:", str(value))):
            if name not in RESOLVERS:
                cure = f"settings may call {', '.join(RESOLVERS)}; type the value"
                yield key, f"calls {shortened(repr(name), 60)}; {cure}"


def is_import_path(value: object) -> bool:
    return isinstance(value, str) and ":" in value and "$" not in value  # Hydra interpolates a $


class Composer:
    """Composes and checks a command's settings, from a file `name`, and a `folder` beside ours."""

    def __init__(self, command: "Command", name: str | None = None, folder: str | None = None):
        self.command, self.name, self.folder = command, name or command.name, folder
        if folder and not os.path.isdir(folder):
            raise UserError(f"There is no folder {folder} with configurations")
        for group in components.CHOSEN:
            for member, path in components.members(group).items():
                if not os.path.exists(package.CONFIGS / group / f"{member}.yaml"):
                    store_member(group, member, path)
        STORE.store(group="logger", name="none", node={})
        Folders.beside = os.path.abspath(folder) if folder else ""
        global_hydra.GlobalHydra.instance().clear()
        for kind in (BlockSource, Folders):  # a launcher's process may have forgotten them
            plugins.Plugins.instance().register(kind)
        hydra.initialize_config_dir(MAIN, job_name=command.name, version_base="1.3")
        self.loader = global_hydra.GlobalHydra.instance().config_loader()
        self.members = functools.cache(self.loader.get_group_options)
        self.top = functools.cache(lambda: self.loader.list_groups(""))
        self.composed = functools.cache(self._composed)

    def groups(self) -> dict[str, list[str]]:
        """Returns {group: members} of the groups to choose from."""
        choices = self.composed(device="cpu").hydra.runtime.choices
        names = {group for group in choices if "/" not in group}
        names |= {*self.top()} if self.folder else set()
        # import paths that were given in this process are members too
        files = {name: [m for m in self.members(name) if ":" not in m] for name in sorted(names)}
        return {name: members for name, members in files.items() if members and name != "hydra"}

    def parse(self, words: Iterable[str]) -> list[types.Override]:
        """Returns words as Hydra's grammar reads them."""

        def is_left_out_anyway(one) -> bool:  # a group, for which Hydra has no word
            is_none = one.value() is None and bool(self.members(one.key_or_group))
            return is_none and self.composed().hydra.runtime.choices.get(key_of(one)) is None

        overrides = parse(words, self.command.kind, self.cure_for_value, self.loader)
        return [one for one in overrides if not is_left_out_anyway(one)]

    def _group_names(self) -> list[str]:
        return [*self.top(), *(f"hydra/{name}" for name in self.loader.list_groups("hydra"))]

    def settings(self, words: Iterable[str]) -> Any:
        return self.compose(words)[0]

    def compose(self, words: Iterable[str]) -> tuple[Any, DictConfig]:
        """Returns checked settings, and the configuration they are from, Hydra's part included."""
        typed, errors = [], []
        for one in self.parse(words):
            if one.is_sweep_override():
                text = f"{one.input_line!r} has several values; add -m to sweep"
                errors.append((key_of(one), text))
            else:
                typed.append(typed_word(one))
        return self.checked(typed, errors)

    def checked(self, typed: list[Typed], errors: list) -> tuple[Any, DictConfig]:
        """Returns what `compose` does. `errors` has what is wrong already."""
        config, more = self.config(typed)
        secret = [*refused_resolvers(own(config))]
        errors = [*errors, *more]
        try:
            keys = [one.key for one in typed if not one.key.startswith("hydra")]
            tree = self.command.prepare(own(config, resolve=not secret), keys)
            if tree.get("geometry", {}).get("name") == components.HOMES:
                from megastep.geometries import databases

                databases.prefetch()  # while PyTorch is imported
            chosen = check.check(self.command.kind, tree, self._group_names)
            errors += conflicts.ignored_geometry(chosen.env, keys)
        except OmegaConfBaseException as error:
            errors.append((error.full_key or "configuration", str(error).partition("\n")[0]))
        except ConfigErrors as error:
            of_words = {key for key, _ in errors}  # what follows from them is not said again
            errors += [(key, text) for key, text in error.errors if key not in of_words]
        if errors + secret:
            raise ConfigErrors(errors + secret)
        return chosen, config

    def printed(self, words: Iterable[str], part: str) -> str:
        """Returns the checked settings as YAML, Hydra's own, or all."""
        cfg, config = self.compose(words)
        tree = {} if part == "hydra" else check.as_tree(cfg)
        return OmegaConf.to_yaml(tree if part == "job" else tree | {"hydra": config.hydra})

    def cure_for_value(self, word: str) -> str:
        """Returns what to say of a word without `=`: the key that it may be a value of."""
        word, names = word.lstrip("+"), [*self.command.kind.__pydantic_fields__]
        if word.partition(".")[0] in names and "/" not in word:
            return f"has no value; write {word}=..."
        keys = []
        with suppress(*HYDRA_ERRORS):  # in files, which are named when they are composed
            keys = [group for group, members in self.groups().items() if word in members]
        if word == "latest" or "/" in word:
            keys += [key for key in ("run", "resume") if key in names]
        if not keys:
            return "is not key=value; --cfg job prints all keys"
        return f"is not key=value; did you mean {keys[0]}={word}?"

    def config(self, typed: list[Typed]) -> tuple[DictConfig, list[tuple[str, str]]]:
        """Returns (the configuration, the errors of settings that are not in it)."""
        groups, keys, errors = [], {}, []
        for one in typed:
            group = one.key.partition("@")[0]
            options = self.members(group) if "/" in group or group in self.top() else []
            chosen = one.value if group == "logger" and isinstance(one.value, list) else [one.value]
            others = [member for member in chosen if member not in options]
            labels = [components.label(name) for name in {*map(str, chosen)}]
            if len({*labels}) < len(labels):
                text = "two loggers have the same class name, and so the same keys"
                errors.append((one.key, text))
            elif one.key == "hydra.searchpath" or options and not others:
                groups.append(one.word)
            elif not options or isinstance(one.value, dict):
                keys[one.key] = one
            elif group in components.CHOSEN and all(map(is_import_path, others)):
                for name in map(str, others):
                    store_member(group, name, name)
                groups.append(one.word)
            else:
                unknown = next(member for member in others if not is_import_path(member))
                hint = f"is unknown; {closest(unknown, options)}"
                if unknown in EXTRAS:
                    hint = f"is not installed: pip install '{package.DISTRIBUTION}[sweep]'"
                errors.append((one.key, f"{shortened(repr(unknown))} {hint}"))
        try:
            device, learner = (
                str(keys[key].value) if key in keys else None for key in ("device", "learner.name")
            )
            config = copy.deepcopy(self.composed(*groups, device=device, learner=learner))
            leave_out_others(config, learner)
        except FILE_ERRORS as error:
            absent = isinstance(error, MissingConfigException) and error.missing_cfg_file
            text = "is in none of the folders searched; --config-dir adds one" if absent else error
            errors.append((absent or "configuration", shortened(text, 400)))
            raise ConfigErrors(errors) from None
        for key, one in keys.items():
            try:
                if one.is_delete:
                    parent, _, leaf = key.rpartition(".")
                    del (OmegaConf.select(config, parent) if parent else config)[leaf]
                else:
                    force = one.is_added or not key.startswith("hydra.")
                    OmegaConf.update(config, key, one.value, force_add=force)
            except (ConfigKeyError, ConfigAttributeError, TypeError):  # TypeError: below a value
                known = dict(check.leaves({"hydra": plain(config.hydra)}))
                errors.append((key, f"no such key; {check.closest_key(key, known)}"))
            except OmegaConfBaseException as error:
                errors.append((key, str(error).partition("\n")[0]))
        return config, errors

    def _composed(
        self, *groups: str, device: str | None = None, learner: str | None = None
    ) -> DictConfig:
        """Returns the configuration of files, with the blocks of the device and learner in them."""
        typed = dict(word.lstrip("+").split("=", 1) for word in groups if "=" in word)
        applied = blocks_of(device or "auto", learner or typed.get("learner", GUESS))
        while True:
            BlockSource.blocks = applied
            config = hydra.compose(self.name, [*groups], return_hydra_config=True)
            chosen = OmegaConf.select(config, "learner.name")
            applied = blocks_of(device or config.get("device") or "auto", learner or chosen)
            if applied == BlockSource.blocks:
                OmegaConf.set_struct(config, False)
                return config
            learner = learner or chosen  # which a block may not choose


def store_member(group: str, member: str, path: str) -> None:
    """Has Hydra know a member of a group that no file in configs/ names."""
    node: dict = {"name": path}
    if group == "logger":
        node = {components.label(path): node}
    elif group == "learner":  # it has the file of the one that it derives from
        base = built_in(path) if member == path else None
        node["defaults"] = [*filter(None, [base]), "_self_"]
    STORE.store(group=group, name=member, node=node)


def settings_from(command: "Command", arguments: Mapping[str, Any]) -> Any:
    """Returns the checked settings of a command from keyword arguments."""
    state = global_hydra.GlobalHydra.instance()
    before = state.hydra  # of a program of the user's
    try:
        return Composer(command).checked(typed_of(arguments), [])[0]
    finally:
        state.clear()
        state.hydra = before
