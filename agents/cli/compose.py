"""Command line -> Hydra -> checked settings. Everything is composed and checked before anything is
written.

Hydra is used through its compose API and its override grammar; `@hydra.main` would make its folder
first, and exit 1.
"""

from pathlib import Path
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from agents.cli.build import as_tree, build
from agents.cli.errors import ConfigErrors, UserError, closest

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
Tree = dict[str, Any]


class ConfigLoader:
    """Composes and checks the configuration of one script; a context, as Hydra keeps its state in a
    global.
    """

    def __init__(self, script: str, kind: type):
        self.script, self.kind = script, kind

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
        defaults = yaml.safe_load((CONFIGS / f"{self.script}.yaml").read_text())["defaults"]
        chosen = [group for default in defaults if isinstance(default, dict) for group in default]
        return {group: loader.get_group_options(group) for group in chosen}

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
        for override in _parsed(overrides):
            key, member = override.key_or_group, override.value()
            if key not in groups:
                good.append(f"++{override.input_line}")  # `build` knows which keys there are
            elif member is None or member in groups[key]:
                good.append(override.input_line)
            else:
                errors.append((key, f"{member!r} is unknown; {closest(member, groups[key])}"))
        try:
            settings = build(self.kind, _plain(self._compose(good)), list(groups))
        except ConfigErrors as error:
            errors += error.errors
        except (HydraException, OmegaConfBaseException) as error:
            errors.append(("configuration", " ".join(str(error).split())))
        if errors:
            raise ConfigErrors(errors)
        return as_tree(settings)

    def _compose(self, overrides: list[str]) -> DictConfig:
        """With a GPU to run on, `preset=auto` is replaced by `preset=gpu`; without one it is `cpu`
        already.
        """
        config = compose(self.script, overrides, return_hydra_config=True)
        if config.hydra.runtime.choices.get("preset") == "auto" and _has_gpu(config.device):
            config = compose(self.script, [*overrides, "preset=gpu"], return_hydra_config=True)
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


def _has_gpu(device: str) -> bool:
    if device == "cpu":
        return False
    import torch

    return torch.cuda.is_available()


def _plain(config: DictConfig) -> Tree:
    OmegaConf.set_struct(config, False)
    config.pop("hydra")
    return OmegaConf.to_container(config, resolve=True)
