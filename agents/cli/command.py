"""What train, evaluate and record do with a command line: parse, compose, check, run, exit code."""

import argparse
import contextlib
import dataclasses
import io
import re
import sys
from collections.abc import Callable
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.types import RunMode

from megastep.agents.cli import console, doors
from megastep.agents.cli.compose import ConfigLoader, Prepare, as_is
from megastep.agents.cli.console import say
from megastep.agents.cli.doors import told
from megastep.agents.cli.errors import ConfigErrors, UserError
from megastep.agents.cli.help import help_text
from megastep.agents.cli.signals import Interrupted, Interruptions, interrupt
from megastep.agents.cli.sweep import sweep


@dataclasses.dataclass(frozen=True)
class Script:
    """One of the things that can be done. `run(settings)`, of dataclass `kind`, does it; `prepare`
    may change a composed tree before it is checked; `help` is the head of `--help`.
    """

    name: str
    kind: type
    run: Callable[[Any], Any]
    help: str
    prepare: Prepare = as_is


def run_command(script: Script, argv: list[str] | None = None) -> int:
    """Parses, composes, checks, runs; returns the exit code."""
    console.warn_in_lines()
    options = _options(script.name, sys.argv[1:] if argv is None else argv)
    try:
        with Interruptions(interrupt) as signals:
            code = _run(script, options)
        return code if signals.number is None else 128 + signals.number
    except UserError as error:
        say(f"{told(script.name)}: {error}", sys.stderr)
        return error.code
    except Interrupted as stop:
        say(f"{told(script.name)}: {stop}", sys.stderr)
        return 128 + stop.number


def _run(script: Script, options: argparse.Namespace) -> int:
    options.multirun |= "hydra.mode=MULTIRUN" in options.overrides
    if not options.multirun:
        options.overrides = _with_folder(script, options.overrides)
    words, places = options.overrides, (options.config_name, options.config_dir)
    with ConfigLoader(
        script.name, script.kind, script.prepare, *places, options.config_path
    ) as loader:
        if text := _text(script, loader, options):
            say(text.rstrip("\n"))
        elif options.shell_completion:
            loader.complete(words)
        elif options.info:
            loader.hydra.show_info(options.info, loader.name, words)
        elif options.multirun:
            return sweep(loader, script.run, words)
        else:
            settings, config = loader.composed(words)
            if config.hydra.mode == RunMode.MULTIRUN:
                return sweep(loader, script.run, words)
            script.run(settings)
    return 0


def _with_folder(script: Script, words: list[str]) -> list[str]:
    """The words of a single run: what Hydra calls hydra.run.dir is its folder."""
    if not any(word.startswith("hydra.run.dir=") for word in words):
        return words
    if "folder" not in script.kind.__dataclass_fields__:
        raise ConfigErrors([("hydra.run.dir", f"{script.name} makes no folder")])
    return [re.sub(r"^hydra\.run\.dir=", "folder=", word) for word in words]


def _text(script: Script, loader: ConfigLoader, options: argparse.Namespace) -> str:
    """What an option has printed, if it is one of those."""
    if options.help:
        return help_text(script.name, script.help, loader.groups())
    if options.hydra_help:
        with contextlib.redirect_stdout(io.StringIO()) as text:
            loader.hydra.hydra_help(loader.name, get_args_parser(), options)
        return text.getvalue()
    if not options.cfg:
        return ""
    jobs = [options.overrides]
    if options.multirun:
        jobs = [words for words, _ in loader.jobs(options.overrides)]
    printed = [loader.printed(job, options.cfg, options.package, options.resolve) for job in jobs]
    return "---\n".join(printed)


def _options(script: str, argv: list[str]) -> argparse.Namespace:
    """Hydra's options, and the overrides between them."""
    parser = get_args_parser()
    parser.prog, parser.description = told(script), None
    parser.usage = f"{parser.prog} [-m] [key=value ...]; --help says more"
    for action in parser._actions:
        if action.dest == "version":
            action.version = f"{doors.version()}, Hydra {hydra.__version__}"
    options = parser.parse_intermixed_args(argv)
    if options.experimental_rerun:
        parser.error("--experimental-rerun: a run is continued with resume=RUN")
    if options.resolve and not options.cfg:
        parser.error("--resolve goes with --cfg")
    return options
