"""The command that trains a policy. `train --help` lists the choices."""

import functools
from pathlib import Path

from megastep.agents.cli import command, scripts
from megastep.agents.factory import settings

#: Runs the command with words of a command line, by default this process's.
main = functools.partial(command.run_command, scripts.TRAIN)


def run(cfg: settings.Train) -> Path | None:
    """Trains as `cfg` says; see `megastep.agents.launch.train.run`."""
    from megastep.agents.launch import train  # with PyTorch

    return train.run(cfg)
