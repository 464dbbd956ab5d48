"""The door: command line -> Hydra -> checked settings. Everything is composed and checked before
anything is written.

Hydra is used through its compose API and its override grammar; `@hydra.main` would make its folder
first, and exit 1.
"""

from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from agents.cli.settings import ConfigErrors, UserError, build, closest, closest_key

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


class ConfigLoader:
    """Composes and checks the configuration of one script; a context, as Hydra keeps its state in a
    global.
    """

    def __init__(self, script, kind):
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

    def groups(self):
        """{group: [members]}; train.yaml and its fellows are no groups."""
        loader = GlobalHydra.instance().config_loader()
        chosen = self._compose([], hydra=True).hydra.runtime.choices
        return {
            g: loader.get_group_options(g)
            for g in loader.get_group_options("", ObjectType.GROUP)
            if g in chosen
        }

    def jobs(self, overrides, multirun=False):
        """The composed tree of each job, `[(overrides, nested dict)]`; one job unless multirun."""
        parsed = self._parsed(overrides, multirun)
        if not multirun:
            return [(overrides, self.tree(overrides))]
        try:
            batches = BasicSweeper.split_arguments(parsed, max_batch_size=None)[0]
        except HydraException as error:
            raise UserError(f"This sweep cannot be split: {error}") from None
        return [(list(job), self.tree(list(job))) for job in batches]

    def tree(self, overrides):
        """Nested dicts for one list of overrides. ConfigErrors names every unknown key and group
        member, and bad value.
        """
        errors, fine, groups = [], [], self.groups()
        choices = [o for o in self._parsed(overrides) if o.key_or_group in groups]
        for choice in choices:
            member, members = choice.value(), groups[choice.key_or_group]
            if member is not None and member not in members:
                errors.append(
                    (choice.key_or_group, f"{member!r} is unknown; {closest(member, members)}")
                )
            else:
                fine.append(choice.input_line)
        keys = list(_paths(_plain(self._compose(fine))))
        for override in self._parsed(overrides):
            key = override.key_or_group
            if key in groups:
                continue
            if key in keys or any(k.startswith(key + ".") for k in keys):
                fine.append(override.input_line)
            else:
                errors.append((key, f"no such key; {closest_key(key, [*keys, *groups])}"))
        try:
            tree = _plain(self._compose(fine))
        except (HydraException, OmegaConfBaseException) as error:
            raise ConfigErrors([*errors, ("configuration", " ".join(str(error).split()))]) from None
        try:
            build(self.kind, tree)
        except ConfigErrors as error:
            errors += error.errors
        if errors:
            raise ConfigErrors(errors)
        return tree

    def _compose(self, overrides, hydra=False):
        """With a GPU to run on, `agent=auto` is replaced by `agent=large`; without one it is
        `small` already.
        """
        config = compose(self.script, overrides, return_hydra_config=True)
        if config.hydra.runtime.choices.get("agent") == "auto" and _has_gpu(config.get("device")):
            config = compose(self.script, [*overrides, "agent=large"], return_hydra_config=True)
        if not hydra:
            OmegaConf.set_struct(config, False)
            config.pop("hydra")
        return config

    def _parsed(self, overrides, multirun=False):
        errors, parsed = [], []
        for text in overrides:
            try:
                override = OverridesParser.create().parse_override(text)
            except HydraException:
                errors.append(
                    (
                        text,
                        "is not understood; write key=value, quote blanks and brackets: 'key=\"a "
                        "b\"'",
                    )
                )
                continue
            if override.type.name != "CHANGE" or override.package is not None:
                errors.append((text, "keys and groups are fixed; write key=value or group=member"))
            elif override.is_sweep_override() and not multirun:
                errors.append((override.key_or_group, f"{text!r} asks for several runs; add -m"))
            else:
                parsed.append(override)
        if errors:
            raise ConfigErrors(errors)
        return parsed


def _has_gpu(device):
    if device == "cpu":
        return False
    import torch

    return torch.cuda.is_available()


def _plain(config):
    return OmegaConf.to_container(config, resolve=True)


def _paths(tree, prefix=""):
    for key, value in tree.items():
        yield prefix + key
        if isinstance(value, dict):
            yield from _paths(value, f"{prefix}{key}.")
