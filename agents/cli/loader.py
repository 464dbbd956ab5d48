"""Hydra's loader of configurations, with what ours need besides; all of Hydra composes with it, in
whichever process a launcher runs a job.
"""

import re
from collections.abc import Callable, Iterable
from typing import Any

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, MissingConfigException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from megastep.agents.cli import overrides as words_of
from megastep.agents.cli.doors import DISTRIBUTION
from megastep.agents.cli.errors import ConfigErrors, closest_key
from megastep.agents.cli.settings import GROUPS
from megastep.settings import closest

#: Members that come with what this installs.
EXTRA = f"pip install '{DISTRIBUTION}[sweep]'"
EXTRAS = ("joblib", "optuna", "submitit_local", "submitit_slurm")


class Loader(ConfigLoaderImpl):
    """Composes as Hydra does, but: a key need not be in a file, for settings are the arguments of
    constructors; a member of a group may be an import path; preset=auto becomes gpu or cpu, by the
    device of the process that composes; a job is named by what varies in its sweep.
    """

    def __init__(self, config_search_path: ConfigSearchPath):
        super().__init__(config_search_path)
        self._repositories = {}
        #: What gives the keys that a configuration has beside those in files, if they are wanted.
        self.keys: Callable[[DictConfig], Iterable[str]] | None = None

    def __getstate__(self):
        return self.__dict__ | {"_repositories": {}}

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        """ConfigErrors if there are words that Hydra cannot be given."""
        words, errors = self.translated(overrides, config_name, run_mode)
        if errors:
            raise ConfigErrors(errors)
        options = run_mode, from_shell, validate_sweep_overrides
        config = super().load_configuration(config_name, words, *options)
        if config.hydra.runtime.choices.get("preset") == "auto" and run_mode == RunMode.RUN:
            preset = "preset=gpu" if has_gpu(config.get("device")) else "preset=cpu"
            config = super().load_configuration(config_name, [*words, preset], *options)
        typed = words_of.parse(overrides, multirun=run_mode == RunMode.MULTIRUN)
        config.hydra.overrides.task = [
            one.input_line for one in typed if not words_of.is_hydra(one)
        ]
        for key in self.keys(config) if self.keys else ():
            if OmegaConf.select(config, key) is None:
                OmegaConf.update(config, key, None, force_add=True)
        return config

    def compute_defaults_list(self, config_name, overrides, run_mode):
        words, _ = self.translated(overrides, config_name, run_mode)
        return super().compute_defaults_list(config_name, words, run_mode)

    def load_sweep_config(self, master_config: DictConfig, sweep_overrides: list[str]):
        config = super().load_sweep_config(master_config, sweep_overrides)
        fixed = words_of.fixed_keys(master_config.hydra.overrides.task)
        left_out = config.hydra.job.config.override_dirname.exclude_keys
        values = words_of.varied(sweep_overrides, [*fixed, *left_out])
        config.hydra.job.override_dirname = words_of.name_of(values)
        return config

    def translated(
        self, overrides: Iterable[str], config_name: str | None, run_mode: RunMode
    ) -> tuple[list[str], list[tuple[str, str]]]:
        """The words that Hydra is given for those that were typed, and the errors in the others:
        `(key, sentence)` each.
        """
        multirun = run_mode == RunMode.MULTIRUN
        words, errors = [], []
        for override in words_of.parse(overrides, self, multirun):
            key, value = words_of.key_of(override), override.value()
            options = self.members(override.key_or_group, config_name, overrides)
            if override.is_sweep_override() and not multirun:
                errors.append((key, f"{override.input_line!r} means several runs; add -m"))
            elif words_of.is_hydra(override) and not options and "/" not in key:
                words.append(override.input_line)
            elif not options and ("@" in key or "/" in key):
                parent, _, _ = override.key_or_group.rpartition("/")
                groups = [f"{parent}/{one}".lstrip("/") for one in self.list_groups(parent)]
                errors.append((key, f"there is no such group; {closest(key, groups)}"))
            elif override.is_delete() and not options:
                words.append(override.input_line)
            elif not options or isinstance(value, dict):
                words.append(f"++{key}={override.get_value_string()}")
            elif value is None:  # a group's ~ as well
                if self._defaults(config_name).get(key) is not None:
                    errors.append((key, f"cannot be left out; there are {', '.join(options)}"))
            elif error := _member_error(override, options):
                errors.append((key, error))
            elif override.is_add() or override.is_force_add():  # + if there is no default for it
                is_chosen = key in self._defaults(config_name)
                words.append(f"{'' if is_chosen else '+'}{key}={override.get_value_string()}")
            else:
                words.append(override.input_line)
        return words, errors

    def members(
        self, group: str, config_name: str | None = None, overrides: Iterable[str] = ()
    ) -> list[str]:
        """The members of a group in all the folders that are searched; none if it is no group."""
        folders = tuple(one for one in overrides if one.lstrip("+").startswith("hydra.searchpath="))
        if (config_name, folders) not in self._repositories:  # a copy of one takes 30 ms
            _, found = self._parse_overrides_and_create_caching_repo(config_name, [*folders])
            self._repositories[config_name, folders] = found
        return self._repositories[config_name, folders].get_group_options(group)

    def _defaults(self, config_name: str | None) -> dict[str, Any]:
        """{group: member} that are chosen without a word."""
        return super().compute_defaults_list(config_name, [], RunMode.RUN).overrides.known_choices


def _member_error(override: Override, options: list[str]) -> str | None:
    """What is wrong with what a group is said to be."""
    members = override.value()
    if override.is_sweep_override():
        if not override.is_choice_sweep():
            return f"{override.input_line!r} is no choice; there are {', '.join(options)}"
        members = [Override._convert_value(one) for one in override.sweep_iterator()]
    for member in members if isinstance(members, list) else [members]:
        if member in options or _is_stored(override.key_or_group, member):
            continue
        if member in EXTRAS and override.key_or_group.startswith("hydra/"):
            return f"{member} is not installed: {EXTRA}"
        return f"{member!r} is unknown; {closest(member, options)}"
    return None


def _is_stored(group: str, member: Any) -> bool:
    """Whether a member of a group is an import path; then Hydra is told of it."""
    is_path = isinstance(member, str) and ":" in member and len(member) <= words_of.LONGEST
    if not is_path or not getattr(GROUPS.get(group), "takes_imports", False):
        return False
    ConfigStore.instance().store(group=group, name=member, node={"name": member})
    return True


def has_gpu(device: object) -> bool:
    """Whether there is a GPU to run on, if `device` says so."""
    if device == "cpu":
        return False
    import torch

    return torch.cuda.is_available()


def maximise() -> None:
    """Has Optuna look for high returns by default, and go past jobs that fail; it would look for
    low ones, and stop.
    """
    Plugins.instance()  # which stores what they are by default
    try:
        from hydra_plugins.hydra_optuna_sweeper.config import Direction, OptunaSweeperConf
    except ImportError:
        return
    node = OptunaSweeperConf(direction=Direction.maximize, max_failure_rate=1.0)
    ConfigStore.instance().store(
        group="hydra/sweeper", name="optuna", node=node, provider="optuna_sweeper"
    )


def hydra_error(error: Exception, config: DictConfig | None) -> tuple[str, str]:
    """(key, sentence) for what Hydra says of a word. `config`: Hydra's own settings, for names."""
    text, cause = " ".join(str(error).split()), error.__cause__ or error.__context__
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        return error.missing_cfg_file, "is in no folder that is searched; --config-dir adds one"
    if unknown := re.match(r"Could not (override|delete from config\.) '(.+?)'", text):
        verb, key = unknown.groups()
        if verb != "override" and not key.startswith("hydra."):
            return key, "cannot be deleted, as no file has it"
        if verb == "override" and not key.startswith("hydra."):  # a group, for keys are added
            return key, f"has no default; +{key}= adds it"
        return key, f"no such key; {closest_key(key, _keys(config))}"
    if bad := re.match(r"Error merging override \+*([^=\s]+)=", text):
        return bad[1], _first(cause or error)
    if isinstance(error, HydraException) and not text and cause:
        error = cause
    return getattr(error, "full_key", None) or "configuration", _first(error)


def _first(error):
    """Its first paragraph; OmegaConf has a key and a type in lines of their own."""
    lines = str(error).splitlines() or [type(error).__name__]
    lines = [line for line in lines if not line.strip().startswith(("full_key:", "object_type="))]
    return " ".join(" ".join(lines).split())


def _keys(config, path="hydra"):
    """The dotted keys of Hydra's own settings."""
    found = []
    for key in config or ():
        found.append(f"{path}.{key}")
        if not OmegaConf.is_missing(config, key) and not OmegaConf.is_interpolation(config, key):
            if OmegaConf.is_dict(config[key]):
                found += _keys(config[key], found[-1])
    return found
