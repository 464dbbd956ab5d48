"""The command that films a trained policy. `record --help` lists the choices."""

import functools
from pathlib import Path

from megastep.agents.cli import command, scripts
from megastep.agents.factory import settings

#: Runs the command with words of a command line, by default this process's.
main = functools.partial(command.run_command, scripts.RECORD)


def run(cfg: settings.Record) -> Path:
    """Films an agent; see `megastep.agents.evaluation.record.run`."""
    from megastep.agents.evaluation import filming  # with PyTorch

    return filming.run(cfg)
