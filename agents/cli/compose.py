"""Command line -> Hydra -> checked settings. Everything is composed and checked before anything is
written.

Hydra is used through its compose API and its override grammar; `@hydra.main` would make its folder
first, and exit 1.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from agents.cli.build import build
from agents.cli.errors import ConfigErrors, UserError, closest, closest_key

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
        """{group: [members]}; train.yaml and its fellows are no groups."""
        loader = GlobalHydra.instance().config_loader()
        chosen = self._compose([]).hydra.runtime.choices
        return {
            g: loader.get_group_options(g)
            for g in loader.get_group_options("", ObjectType.GROUP)
            if g in chosen
        }

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
        """Nested dicts for one list of overrides. ConfigErrors names every unknown key and group
        member, and bad value.
        """
        parsed = _parsed(overrides)
        try:
            tree = _plain(self._compose(overrides))
        except (HydraException, OmegaConfBaseException) as error:
            raise ConfigErrors(self._errors(parsed) or [_as_error(error)]) from None
        build(self.kind, tree)
        return tree

    def _errors(self, parsed: list[Override]) -> list[tuple[str, str]]:
        """What is wrong with overrides that cannot be composed, and with the values of the rest."""
        errors, good, groups = [], [], self.groups()
        for choice in (o for o in parsed if o.key_or_group in groups):
            member, members = choice.value(), groups[choice.key_or_group]
            if member is None or member in members:
                good.append(choice.input_line)
            else:
                sentence = f"{member!r} is unknown; {closest(member, members)}"
                errors.append((choice.key_or_group, sentence))
        keys = list(_paths(_plain(self._compose(good))))
        for override in (o for o in parsed if o.key_or_group not in groups):
            key = override.key_or_group
            if key in keys:
                good.append(override.input_line)
            elif chosen := self._with_key(key, groups):
                errors.append((key, f"no such key here; {chosen} has it"))
            else:
                errors.append((key, f"no such key; {closest_key(key, [*keys, *groups])}"))
        try:
            build(self.kind, _plain(self._compose(good)))
        except (HydraException, OmegaConfBaseException) as error:
            errors.append(_as_error(error))
        except ConfigErrors as error:
            errors += error.errors
        return errors

    def _with_key(self, key: str, groups: dict[str, list[str]]) -> str | None:
        """The choice of a group's member that has this key: `logger=wandb` for logger.mode."""
        group = key.partition(".")[0]
        for member in groups.get(group, ()):
            if key in _paths(_plain(self._compose([f"{group}={member}"]))):
                return f"{group}={member}"
        return None

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


def _as_error(error: Exception) -> tuple[str, str]:
    return "configuration", " ".join(str(error).split())


def _has_gpu(device: str) -> bool:
    if device == "cpu":
        return False
    import torch

    return torch.cuda.is_available()


def _plain(config: DictConfig) -> Tree:
    OmegaConf.set_struct(config, False)
    config.pop("hydra")
    return OmegaConf.to_container(config, resolve=True)


def _paths(tree: Tree, prefix: str = "") -> Iterator[str]:
    """The dotted key of every value and every group of values."""
    for key, value in tree.items():
        yield prefix + key
        if isinstance(value, dict):
            yield from _paths(value, f"{prefix}{key}.")
