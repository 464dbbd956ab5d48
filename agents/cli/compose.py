"""Command line -> Hydra -> checked settings. Everything is composed and checked before anything is
written.

Hydra is used through its compose API and its override grammar; `@hydra.main` would make its folder
first, and exit 1.
"""

from collections.abc import Callable
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from agents.cli.build import as_tree, build
from agents.cli.errors import ConfigErrors, UserError
from agents.cli.registry import CONFIGS
from agents.cli.settings import GROUPS
from megastep.settings import closest

Tree = dict[str, Any]
#: Changes a composed tree before it is checked, given the overrides.
Prepare = Callable[[Tree, list[str]], Tree]


class ConfigLoader:
    """Composes and checks the configuration of one script; a context, as Hydra keeps its state in a
    global. `prepare` may change what was composed before it is checked.
    """

    def __init__(self, script: str, kind: type, prepare: Prepare = lambda tree, overrides: tree):
        self.script, self.kind, self.prepare = script, kind, prepare

    def __enter__(self):
        GlobalHydra.instance().clear()
        self._context = initialize_config_dir(
            str(CONFIGS), version_base="1.3", job_name=self.script
        )
        self._context.__enter__()
        return self

    def __exit__(self, *error):
        return self._context.__exit__(*error)

    def groups(self) -> dict[str, list[str]]:
        """{group: [members]}: those that the script's own file has a default for."""
        loader = GlobalHydra.instance().config_loader()
        members = {group: loader.get_group_options(group) for group in self._defaults()}
        return {group: [m for m in found if ":" not in m] for group, found in members.items()}

    def _defaults(self) -> dict[str, str | None]:
        """{group: member} of the script's own file, but for what follows from other members."""
        defaults = yaml.safe_load((CONFIGS / f"{self.script}.yaml").read_text())["defaults"]
        groups = {
            k: v for default in defaults if isinstance(default, dict) for k, v in default.items()
        }
        return {group: member for group, member in groups.items() if "@" not in group}

    def jobs(self, overrides: list[str], multirun: bool = False) -> list[tuple[list[str], Tree]]:
        """The composed tree of each job, `[(overrides, nested dict)]`; one job unless multirun."""
        parsed = _parsed(overrides, multirun)
        if not multirun:
            return [(overrides, self.tree(overrides))]
        try:
            batches = BasicSweeper.split_arguments(parsed, max_batch_size=None)[0]
        except HydraException as error:
            raise UserError(f"This sweep cannot be split: {error}") from None
        return [(list(job), self.tree(list(job))) for job in batches]

    def tree(self, overrides: list[str]) -> Tree:
        """Nested dicts for one list of overrides, every setting in them. ConfigErrors names every
        unknown key and group member, and bad value.
        """
        errors, good, groups = [], [], self.groups()
        optional = [group for group, member in self._defaults().items() if member is None]
        for override in _parsed(overrides):
            key, member = override.key_or_group, override.value()
            if key not in groups:
                good.append(f"++{override.input_line}")  # `build` knows which keys there are
            elif member is None and key in optional:
                continue  # it is null already
            elif member in groups[key] or _is_stored(key, member):
                good.append(override.input_line)
            else:
                errors.append((key, f"{member!r} is unknown; {closest(member, groups[key])}"))
        try:
            tree = self.prepare(_plain(self._compose(good)), overrides)
            settings = build(self.kind, tree, list(groups))
        except ConfigErrors as error:
            errors += error.errors
        except (HydraException, OmegaConfBaseException) as error:
            errors.append(("configuration", " ".join(str(error).split())))
        if errors:
            raise ConfigErrors(errors)
        return as_tree(settings)

    def _compose(self, overrides: list[str]) -> DictConfig:
        """`preset=auto` is replaced by `preset=gpu` with a GPU to run on, else by `preset=cpu`."""
        config = compose(self.script, overrides, return_hydra_config=True)
        if config.hydra.runtime.choices.get("preset") == "auto":
            preset = "preset=gpu" if _has_gpu(config.device) else "preset=cpu"
            config = compose(self.script, [*overrides, preset], return_hydra_config=True)
        return config


def _parsed(overrides: list[str], multirun: bool = False) -> list[Override]:
    """Overrides of keys and groups; ConfigErrors names those that are anything else."""
    errors, parsed = [], []
    for text in overrides:
        try:
            override = OverridesParser.create().parse_override(text)
        except HydraException:
            cure = "write key=value, quote blanks and brackets: 'key=\"a b\"'"
            errors.append((text, f"is not understood; {cure}"))
            continue
        if override.type.name != "CHANGE" or override.package is not None:
            errors.append((text, "keys and groups are fixed; write key=value or group=member"))
        elif override.is_sweep_override() and not multirun:
            errors.append((override.key_or_group, f"{text!r} means several runs; add -m"))
        elif override.key_or_group.partition(".")[0].partition("/")[0] == "hydra":
            errors.append((override.key_or_group, "no such key; Hydra's own settings are fixed"))
        else:
            parsed.append(override)
    if errors:
        raise ConfigErrors(errors)
    return parsed


def _is_stored(group: str, member: str) -> bool:
    """Whether a member of a group is an import path; then Hydra is told of it."""
    if ":" not in str(member) or not getattr(GROUPS.get(group), "takes_imports", False):
        return False
    ConfigStore.instance().store(group=group, name=member, node={"name": member})
    return True


def _has_gpu(device: str) -> bool:
    if device == "cpu":
        return False
    import torch

    return torch.cuda.is_available()


def _plain(config: DictConfig) -> Tree:
    OmegaConf.set_struct(config, False)
    config.pop("hydra")
    return OmegaConf.to_container(config, resolve=True)
