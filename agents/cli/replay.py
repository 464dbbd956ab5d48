"""Shows a run's NaN or infinity again: replays the steps that led to it, from a file of the run."""

import argparse
import functools
import sys
from pathlib import Path

from megastep.agents import console, factory, package
from megastep.agents.algorithms.nonfinite import NonFiniteValue
from megastep.agents.errors import UserError, user_errors
from megastep.agents.launch import signals
from megastep.agents.runs import folders
from megastep.agents.training.nonfinite_replay import Recording, ReplayError


class NotRepeated(UserError):
    """The steps were replayed, and the number was another or finite."""

    code = 1


def main(words: list[str] | None = None) -> int:
    """Replays the file that the words of a command line name. Returns the exit code."""
    parser = argparse.ArgumentParser(
        package.command("replay"), description=__doc__, allow_abbrev=False
    )
    parser.add_argument("file", type=Path, help="nonfinite-SAMPLES.npz, in the folder of its run")
    parser.add_argument(
        "options",
        nargs="*",
        type=_option,
        metavar="key=value",
        help="device=cpu: where; default: as in the run. trust=true: import what it names, though "
        "another user made it",
    )
    try:
        with signals.interrupting():
            arguments = parser.parse_args(words)
            run(arguments.file, **dict(arguments.options))
    except SystemExit as end:  # of argparse
        return end.code or 0
    except UserError as error:
        console.say(f"{package.command('replay')}: {error}", sys.stderr)
        return error.code
    except signals.Interrupted as stop:
        console.say(f"{package.command('replay')}: {stop.args[1]}", sys.stderr)
        return 128 + stop.args[0]
    return 0


def _option(word):
    key, _, value = word.partition("=")
    if word == "trust=true":
        return key, True
    if key != "device" or not value:
        raise argparse.ArgumentTypeError(f"{word!r} is unknown; give device=cpu or trust=true")
    return key, value


def run(path: Path, device: str | None = None, trust: bool = False) -> NonFiniteValue:
    """Builds the environment of a run, replays a file in it, and says what was not finite.

    Args:
        path: the file, in the folder of its run.
        device: where; None for the kind of device that wrote it.
        trust: whether a run that another user made may name modules to import.

    Returns:
        the first non-finite number, which is the file's.

    Raises:
        UserError: the file, its run or the device cannot be used.
        NotRepeated: the number was another one or finite.
    """
    errors = functools.partial(user_errors, f"{path} cannot be replayed: ")
    with errors():
        recording = Recording(path)
    cfg = factory.config_of(folders.load_checkpoint(path.parent, trust))
    device = factory.make_device(device or recording.device)
    env = factory.construct(
        cfg.env,
        geometries=factory.homes(cfg.env, cfg.geometry, "training"),
        seed=cfg.seed,
        device=device,
        privileged=cfg.agent.critic == "asymmetric",
    )
    if cfg.curriculum.name != "none":
        env.weigh_layouts()  # the file has the weights
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
