"""The words of a command line -> Hydra -> checked settings, before anything is written.

Hydra's grammar reads the words, `hydra.compose` composes the groups from files with their `blocks`,
and keys are set in what comes out, so that every error has its own word. Two methods of Hydra are
replaced: `ConfigStore.__deepcopy__` here, and `load_config` of its sources of files in `blocks`.
Jobs of sweeps compose in the same way, in whichever process they run.
"""

import copy
import functools
import itertools
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import Any

import hydra
import yaml
from hydra.core import config_store, global_hydra, plugins
from hydra.core.override_parser import overrides_parser, types
from hydra.errors import HydraException, MissingConfigException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf, grammar_parser
from omegaconf.errors import (
    ConfigAttributeError,
    ConfigKeyError,
    GrammarParseError,
    OmegaConfBaseException,
)
from omegaconf.grammar_parser import OmegaConfGrammarParser  # pyright: ignore[reportPrivateImportUsage]

from megastep.agents import package
from megastep.agents.cli import blocks
from megastep.agents.cli.scripts import Script
from megastep.agents.errors import ConfigErrors, UserError, shortened
from megastep.agents.factory import check, components, settings
from megastep.agents.selfplay.bots import BOTS
from megastep.settings import closest

#: The longest key and member of a group, and the most brackets of a word: Python's recursion ends
#: not far above.
LONGEST, MOST_BRACKETS = 200, 40
#: Bytes that the locale's encoding does not have.
UNDECODED = re.compile(r"[\ud800-\udfff]")
NO_TEXT = "is not valid text in this locale; PYTHONUTF8=1 reads UTF-8"
#: An element of a value with = in it, as folders of sweeps have, and what quotes it.
WITH_EQUALS, QUOTED = re.compile(r"[^\[\],]*=[^\[\],]*"), r'"\g<0>"'
#: Members of Hydra's own groups that come with the optional dependencies.
EXTRAS = ("joblib", "optuna", "submitit_local", "submitit_slurm")
#: Groups with keys that no file has, for they are arguments of constructors.
OPEN = {
    key: OmegaConf.create({}, flags={"struct": False})
    for key in (*settings.IMPORTED, "agent", "opponents")
}
#: The learner whose blocks are tried first where none is typed.
GUESS = "ppo"
#: Resolvers that settings may call: none that reads what is not in the configuration, or reads its
#: argument as a value that may call others.
RESOLVERS = ("now", "oc.dict.keys", "oc.dict.values", "oc.select", "python_version")
ENVIRONMENT = ("oc.env", "env")
#: What Hydra raises for words that it cannot use.
HYDRA_ERRORS = (HydraException, OmegaConfBaseException, yaml.YAMLError, AssertionError)
#: What files of configurations raise beside these: Hydra and YAML have no errors of their own for
#: defaults that are no list or lead back to their own file, and for numbers of 5,000 digits.
FILE_ERRORS = (*HYDRA_ERRORS, ValueError, TypeError, LookupError, RecursionError)
STORE = config_store.ConfigStore.instance()
# Hydra copies its sources of files time and again, and in them this one, which took a third of a
# second: there is only one
config_store.ConfigStore.__deepcopy__ = (  # pyright: ignore[reportAttributeAccessIssue]
    lambda store, memo: store
)
STORE.store(name="open", node=OmegaConf.create(OPEN))
STORE.store(group="logger", name="none", node={})
for label, path in settings.loggers().items():
    STORE.store(group="logger", name=label, node={label: {"name": path}})


class FolderOfUser(SearchPathPlugin):
    """Has Hydra find files and groups in the folder given by --config-dir, beside ours."""

    path: str | None = None

    def manipulate_search_path(self, search_path) -> None:
        if self.path:
            search_path.append("command-line", f"file://{self.path}")


class Composer:
    """Composes and checks the configuration of one script.

    Args:
        script: whose settings they are.
        name: another file than the script's own.
        folder: a folder whose files and groups are found beside ours.
        main: a folder in place of ours.

    Attributes:
        note: a sentence on what a learner of the user has from our files, if it has anything.
    """

    def __init__(
        self,
        script: Script,
        name: str | None = None,
        folder: str | None = None,
        main: str | None = None,
    ):
        self.script, self.name, self.folder = script, name or script.name, folder
        self.main = os.path.abspath(main or package.CONFIGS)
        if absent := [p for p in (folder, self.main) if p and not os.path.isdir(p)]:
            raise UserError(f"There is no folder {absent[0]} with configurations")
        self.note = ""
        for group in ("env", "geometry", "learner"):
            for member, path in components.members(group).items():
                if not os.path.exists(package.CONFIGS / group / f"{member}.yaml"):
                    STORE.store(group=group, name=member, node={"name": path})
        FolderOfUser.path = folder and os.path.abspath(folder)
        plugins.Plugins.instance().register(FolderOfUser)
        global_hydra.GlobalHydra.instance().clear()
        hydra.initialize_config_dir(self.main, job_name=script.name, version_base="1.3")
        self.loader = global_hydra.GlobalHydra.instance().config_loader()
        self.members = functools.cache(self.loader.get_group_options)
        self.composed = functools.cache(self._composed)

    def groups(self) -> dict[str, list[str]]:
        """Returns {group: members} of the groups to choose from."""
        choices = self.composed(device="cpu").hydra.runtime.choices
        names = {group for group in choices if "/" not in group}
        names |= {*self.loader.list_groups("")} if self.folder else set()
        # import paths that were given in this process are members too
        files = {name: [m for m in self.members(name) if ":" not in m] for name in sorted(names)}
        return {name: members for name, members in files.items() if members and name != "hydra"}

    def parse(self, words: Iterable[str]) -> list[types.Override]:
        """Returns words as Hydra's grammar reads them. Raises ConfigErrors with all unreadable
        ones.
        """
        overrides, errors, parser = [], [], overrides_parser.OverridesParser.create(self.loader)
        for word in words:
            key, _, value = word.partition("=")
            n_brackets = value.count("[") + value.count("{")
            is_text = not UNDECODED.search(word)
            fits = is_text and len(key) <= LONGEST and n_brackets <= MOST_BRACKETS
            if fits and "=" not in word and not word.startswith("~"):
                errors.append((shortened(word or "''"), self.cure_for_value(word)))
                continue
            for text in (word, f"{key}={WITH_EQUALS.sub(QUOTED, value)}") if key and fits else ():
                with suppress(HydraException, ValueError):
                    overrides += parser.parse_overrides([text])
                    break
            else:
                cure = "cannot be read; write key=value, and quote blanks: 'key=\"a b\"'"
                cure = cure if is_text else NO_TEXT
                errors.append((shortened(word), cure))
        if errors:
            raise ConfigErrors(errors)
        return [
            one
            for one in overrides
            if one.value() is not None
            or not self.members(one.key_or_group)
            # Hydra has no word for leaving out a group that is left out anyway
            or self.composed().hydra.runtime.choices.get(key_of(one)) is not None
        ]

    def settings(self, words: Iterable[str]) -> Any:
        return self.compose(words)[0]

    def compose(self, words: Iterable[str]) -> tuple[Any, DictConfig]:
        """Returns checked settings, and the configuration they are from, Hydra's part included.
        Raises ConfigErrors with everything that is wrong.
        """
        overrides = self.parse(words)
        config, errors = self.config(overrides)
        secret = [*refused_resolvers(own(config))]
        try:
            typed = [key for key in map(key_of, overrides) if not key.startswith("hydra")]
            tree = self.script.prepare(own(config, resolve=not secret), typed)
            groups = [f"hydra/{name}" for name in self.loader.list_groups("hydra")]
            errors += settings.missing_sources(tree)
            chosen = check.check(self.script.kind, tree, groups + self.loader.list_groups(""))
            errors += settings.ignored_geometry(chosen.env, typed)
            self.note = blocks.note(config, typed)
        except OmegaConfBaseException as error:
            errors.append((error.full_key or "configuration", str(error).partition("\n")[0]))
        except ConfigErrors as error:
            of_words = {key for key, _ in errors}  # what follows from them is not said again
            errors += [(key, text) for key, text in error.errors if key not in of_words]
        if errors + secret:
            raise ConfigErrors(errors + secret)
        return chosen, config

    def cure_for_value(self, word: str) -> str:
        """Returns what to say of a word without `=`: the key that it may be a value of."""
        word = word.lstrip("+")
        names = [name for name, _ in check.fields_of(self.script.kind, {})]
        group, is_nested, _ = word.partition(".")
        if word in names or (is_nested and group in settings.IMPORTED):
            return f"has no value; write {word}=..."
        groups = []
        with suppress(*HYDRA_ERRORS):  # in files, which are named when they are composed
            groups = [group for group, members in self.groups().items() if word in members]
        keys = ["file"] * word.endswith(settings.FILMS)
        keys += ["against"] * (word in ("bot", *BOTS) or ":" in word)
        keys += ["run"]
        keys += ["resume"] * (word == "latest" or "/" in word)
        keys = groups + [key for key in keys if key in names]
        if not word or not keys:
            return "is not key=value; --cfg job prints all keys"
        return f"is not key=value; did you mean {keys[0]}={word}?"

    def config(self, overrides: list[types.Override]) -> tuple[DictConfig, list[tuple[str, str]]]:
        """Returns (the configuration, the errors of words that are not in it)."""
        groups, keys, errors = [], {}, []
        for override in overrides:
            key, group, value = key_of(override), override.key_or_group, override.value()
            options = self.members(group)
            chosen = value if group == "logger" and isinstance(value, list) else [value]
            others = [one for one in chosen if one not in options]
            labels = [settings.label(one) for one in {*map(str, chosen)}]
            if override.is_sweep_override():
                errors.append((key, f"{override.input_line!r} has several values; add -m to sweep"))
            elif len({*labels}) < len(labels):
                errors.append((key, "two loggers have the same class name, and so the same keys"))
            elif key == "hydra.searchpath" or options and not others:
                groups.append(override.input_line)
            elif not options or isinstance(value, dict):
                keys[key] = override
            elif group in settings.IMPORTED and all(map(is_import_path, others)):
                for name in map(str, others):
                    node: dict = {"name": name}
                    if group == "logger":
                        node = {settings.label(name): node}
                    elif group == "learner":  # it has the file of the one that it derives from
                        node["defaults"] = [*filter(None, [blocks.built_in(name)]), "_self_"]
                    STORE.store(group=group, name=name, node=node)
                groups.append(override.input_line)
            else:
                unknown = next(one for one in others if not is_import_path(one))
                hint = f"is unknown; {closest(unknown, options)}"
                if unknown in EXTRAS:
                    hint = f"is not installed: pip install '{package.DISTRIBUTION}[sweep]'"
                errors.append((key, f"{shortened(repr(unknown))} {hint}"))
        try:
            device, learner = (
                str(keys[key].value()) if key in keys else None
                for key in ("device", "learner.name")
            )
            config = copy.deepcopy(self.composed(*groups, device=device, learner=learner))
            blocks.fit(config, learner)
        except FILE_ERRORS as error:
            absent = isinstance(error, MissingConfigException) and error.missing_cfg_file
            text = "is in none of the folders searched; --config-dir adds one" if absent else error
            text = shortened(text, 400)
            raise ConfigErrors([*errors, (absent or "configuration", text)]) from None
        for key, override in keys.items():
            try:
                if override.is_delete():
                    parent, _, leaf = key.rpartition(".")
                    del (OmegaConf.select(config, parent) if parent else config)[leaf]
                elif problem := _text_of_a_key(config, key):
                    errors.append((key, problem))
                else:
                    force = override.is_add() or override.is_force_add() or key[:6] != "hydra."
                    OmegaConf.update(config, key, override.value(), force_add=force)
            except (ConfigKeyError, ConfigAttributeError, TypeError):  # TypeError: below a value
                hint = check.closest_key(
                    key, dict(check.leaves({"hydra": blocks.plain(config.hydra)}))
                )
                errors.append((key, f"no such key; {hint}"))
            except OmegaConfBaseException as error:
                errors.append((key, str(error).partition("\n")[0]))
        return config, errors

    def _composed(
        self, *groups: str, device: str | None = None, learner: str | None = None
    ) -> DictConfig:
        # with the blocks of what is typed, and once more if files choose another device or learner
        typed = dict(word.lstrip("+").split("=", 1) for word in groups if "=" in word)
        blocks.apply(device or "auto", learner or typed.get("learner", GUESS))
        composed = functools.partial(hydra.compose, self.name, [*groups], return_hydra_config=True)
        config, before = composed(), dict(blocks.applied)
        device, name = device or config.get("device") or "auto", "learner.name"
        blocks.apply(device, learner or OmegaConf.select(config, name))
        if blocks.applied != before:
            config = composed()
        OmegaConf.set_struct(config, False)
        return config

    def call_hydra(self, arguments: list[str], task: Callable | None = None) -> None:
        """Calls Hydra's own main with these arguments. Its errors are raised; it sets sys.argv."""
        os.environ["HYDRA_FULL_ERROR"], sys.argv[1:] = "1", arguments
        global_hydra.GlobalHydra.instance().clear()
        hydra.main(config_path=self.main, config_name=self.name, version_base="1.3")(
            task or self.script.run
        )()


def key_of(override: types.Override) -> str:
    """The key or group@package of a word, without the sign before it."""
    return override.get_key_element().lstrip("+~")


def _text_of_a_key(config: DictConfig, key: str) -> str:
    """Returns why a key is refused a part of which looks like a number that is a key; else ""."""
    parts = key.split(".")
    for i, part in enumerate(parts):
        node = OmegaConf.select(config, ".".join(parts[:i])) if i else config
        if not OmegaConf.is_dict(node):
            break
        if near := [one for one in node if not isinstance(one, str) and str(one) == part]:
            group = ".".join(parts[:i])
            return f"{group} has the key {near[0]}, a number; write {group}={{{near[0]}: ...}}"
    return ""


def refused_resolvers(tree: check.Tree) -> Iterator[tuple[str, str]]:
    """Yields (key, sentence) of values that call a resolver which is not one of `RESOLVERS`, as
    OmegaConf's grammar reads them: in any part of a value, with any blanks.
    """
    for key, value in check.leaves(tree):
        for name in dict.fromkeys(itertools.chain(*map(resolvers_in, strings_in(value)))):
            if name in ENVIRONMENT:
                cure = "would be written to config.yaml; type its value"
                yield key, f"is an environment variable, and {cure}"
            elif name not in RESOLVERS:
                cure = f"settings may call {', '.join(RESOLVERS)}; type the value"
                yield key, f"calls {shortened(repr(name), 60)}; {cure}"


def strings_in(value: object) -> Iterator[str]:
    """Yields the texts in nested lists and dicts."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, (list, dict)):
        for part in [*value, *value.values()] if isinstance(value, dict) else value:
            yield from strings_in(part)


def resolvers_in(text: str) -> Iterator[str]:
    """Yields the names of the resolvers that a value calls, those in arguments of others too.

    What cannot be read is no call: resolving it is an error.
    """
    stack = []
    if "${" in text:
        with suppress(GrammarParseError):
            stack.append(grammar_parser.parse(text))
    while stack:
        node = stack.pop()
        if isinstance(node, OmegaConfGrammarParser.InterpolationResolverContext):
            if (resolver := node.resolverName()) is not None:
                yield resolver.getText()
        stack += getattr(node, "children", None) or []


def is_import_path(value: object) -> bool:
    # Hydra would interpolate a $
    return isinstance(value, str) and ":" in value and "$" not in value and len(value) <= LONGEST


def own(config: DictConfig, resolve: bool = False) -> check.Tree:
    """Nested dicts of all but Hydra's part, without groups that nothing is in."""
    keys = [str(key) for key in config if key != "hydra"]
    tree = blocks.plain(OmegaConf.masked_copy(config, keys), resolve)
    return {key: value for key, value in tree.items() if value != {}}
