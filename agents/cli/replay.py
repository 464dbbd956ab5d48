"""Shows a run's NaN or infinity again: replays the steps that led to it, from a file of the run."""

import argparse
import functools
import json
import sys
from pathlib import Path

import yaml

from megastep.agents.algorithms.nonfinite import NonFiniteValue
from megastep.agents.cli import check, console, factory, program, runs, settings, signals
from megastep.agents.training.nonfinite_replay import Recording, ReplayError
from megastep.agents.training.trust import foreign_names


class NotRepeated(program.UserError):
    """The steps were replayed, and the number was another or finite."""

    code = 1


def main(words: list[str] | None = None) -> int:
    """Replays the file that the words of a command line name. Returns the exit code."""
    parser = argparse.ArgumentParser(
        program.name("replay"), description=__doc__, allow_abbrev=False
    )
    parser.add_argument("file", type=Path, help="nonfinite-SAMPLES.npz, in the folder of its run")
    parser.add_argument(
        "settings",
        nargs="*",
        type=_setting,
        help="device=cpu; default: as in the run. trust=true, if another user made the run and it "
        "names modules outside megastep",
    )
    try:
        with signals.interrupting():
            arguments = parser.parse_args(words)
            run(arguments.file, **dict(arguments.settings))
    except SystemExit as end:  # of argparse
        return end.code or 0
    except program.UserError as error:
        console.say(f"{program.name('replay')}: {error}", sys.stderr)
        return error.code
    except signals.Interrupted as stop:
        console.say(f"{program.name('replay')}: {stop.args[1]}", sys.stderr)
        return 128 + stop.args[0]
    return 0


def _setting(word):
    key, _, value = word.partition("=")
    if key == "device" and value:
        return key, value
    if key == "trust" and value in ("true", "false"):
        return key, value == "true"
    raise argparse.ArgumentTypeError(f"{word!r} is unknown; give device=cpu or trust=true")


def run(path: Path, device: str | None = None, trust: bool = False) -> NonFiniteValue:
    """Builds the environment of a run, replays a file in it, and says what was not finite.

    Args:
        path: the file, in the folder of its run.
        device: where; None for the kind of device that wrote it.
        trust: imports modules that the run names, whoever made it.

    Returns:
        the first non-finite number, which is the file's.

    Raises:
        UserError: the file, its run or the device cannot be used.
        NotRepeated: the number was another one or finite.
    """
    errors = functools.partial(program.errors, f"{path} cannot be replayed: ")
    with errors():
        recording = Recording(path)
    cfg = config_of(path.parent, trust)
    device = factory.make_device(device or recording.device)
    env = factory.construct(
        cfg.env,
        geometries=factory.homes(cfg.env, cfg.geometry, "training"),
        seed=cfg.seed,
        device=device,
        privileged=cfg.agent.critic == "asymmetric",
    )
    with errors(kinds=(ReplayError,)):
        value = recording.replay(env)
    if value and (value.name, value.lane, value.step) == recording.place:
        console.say(f"As in the run, on {device}: {value}")
        return value
    name, lane, step = recording.place
    raise NotRepeated(
        f"{path} was replayed on {device}, where {value or 'all numbers were finite'}; in the run, "
        f"{name} of lane {lane} was not finite at step {step:,}. The environment must have changed "
        "since, or what it does depends on more than its tensors and generators"
    )


def config_of(folder: Path, trust: bool) -> settings.Train:
    """Returns the settings of a run. UserError if they cannot be read, or if they name modules that
    neither `trust` nor a checkpoint that this user made allows.
    """
    path = folder / "config.yaml"
    kinds = (OSError, ValueError, RecursionError, yaml.YAMLError, program.ConfigErrors)
    with program.errors(f"{path}, with which the environment is built, cannot be used: ", kinds):
        tree = yaml.safe_load(path.read_bytes())
        names = set() if trust else {*foreign_names(json.dumps({"train": tree}, default=str))}
        if names and (folder / "checkpoints").is_dir():
            saved = json.dumps(runs.load_checkpoint(folder, trust).config)
            names -= {*foreign_names(saved.encode())}
        if names:
            raise program.UserError(
                f"{path} would import {program.shortened(', '.join(sorted(names)))}, which runs "
                "code outside megastep; if you trust it, add trust=true"
            )
        return check.check(settings.Train, tree)
