"""The command that measures a trained policy. `evaluate --help` lists the choices."""

import functools
from pathlib import Path

from megastep.agents.cli import command, scripts
from megastep.agents.factory import settings

#: Runs the command with words of a command line, by default this process's.
main = functools.partial(command.run_command, scripts.EVALUATE)


def run(cfg: settings.Evaluate) -> Path:
    """Evaluates a run; see `megastep.agents.evaluation.evaluate_run.run`."""
    from megastep.agents.evaluation import evaluate_run  # with PyTorch

    return evaluate_run.run(cfg)
