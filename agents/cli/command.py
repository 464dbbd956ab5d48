"""What train.py, evaluate.py and record.py do with a command line: parse, compose, check, run, exit
code.
"""

import argparse
import sys
import warnings
from collections.abc import Callable
from typing import Any

from omegaconf import OmegaConf

from agents.cli.build import build
from agents.cli.compose import ConfigLoader, Prepare
from agents.cli.console import say, warn
from agents.cli.errors import UserError
from agents.cli.help import help_text
from agents.cli.signals import Interrupted, Interruptions, interrupt
from agents.cli.sweep import sweep


def run_command(
    script: str,
    kind: type,
    run: Callable[[Any], Any],
    text: str,
    argv: list[str] | None = None,
    prepare: Prepare = lambda tree, overrides: tree,
) -> int:
    """Parses, composes, checks, runs; returns the exit code.

    `run(settings)` does the work; `prepare(tree, overrides)` may replace a composed tree before it
    is checked. `text` is the head of `--help`.
    """
    warnings.showwarning = lambda message, *_, **__: warn(message)
    options = _options(script, sys.argv[1:] if argv is None else argv)
    try:
        with Interruptions(interrupt) as signals:
            code = _run(script, kind, run, text, options, prepare)
        return code if signals.number is None else 128 + signals.number
    except UserError as error:
        say(f"{script}.py: {error}", sys.stderr)
        return error.code
    except Interrupted as stop:
        say(f"{script}.py: {stop}", sys.stderr)
        return 128 + stop.number


def _run(
    script: str,
    kind: type,
    run: Callable,
    text: str,
    options: argparse.Namespace,
    prepare: Prepare,
) -> int:
    with ConfigLoader(script, kind, prepare) as loader:
        if options.help:
            say(help_text(script, text, loader.groups()))
            return 0
        jobs = loader.jobs(options.overrides, options.multirun)
        settings = [build(kind, tree) for _, tree in jobs]
    if options.cfg:
        say("\n---\n".join(OmegaConf.to_yaml(tree) for _, tree in jobs))
        return 0
    if options.multirun:
        return sweep(run, [overrides for overrides, _ in jobs], settings)
    run(settings[0])
    return 0


def _options(script: str, argv: list[str]) -> argparse.Namespace:
    usage = f"{script}.py [-m] [key=value ...]; --help says more"
    parser = argparse.ArgumentParser(prog=f"{script}.py", add_help=False, usage=usage)
    parser.add_argument("-h", "--help", action="store_true")
    parser.add_argument("-m", "--multirun", action="store_true")
    parser.add_argument("-c", "--cfg", choices=["job"])
    parser.add_argument("overrides", nargs="*")
    return parser.parse_intermixed_args(argv)
