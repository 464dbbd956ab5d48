"""Runs a script from a command line: options, help, exit codes."""

import argparse
import contextlib
import os
import sys
import warnings
from typing import Any

import hydra
from hydra.types import RunMode
from omegaconf import OmegaConf

from megastep.agents import console, package
from megastep.agents.cli import compose, scripts, sweeps
from megastep.agents.errors import user_errors
from megastep.agents.factory import check
from megastep.agents.launch import endings, gpu, rank

#: Hydra's options: their names, and argparse's arguments.
OPTIONS = {
    "-m --multirun": {
        "action": "store_true",
        "help": "a sweep: -m seed=1,2,3; hydra/launcher=joblib runs jobs side by side, "
        "submitit_slurm on a cluster; hydra/sweeper=optuna searches "
        "learner.lr='interval(1e-4,1e-2)'; hydra.sweep.dir=FOLDER is where it goes",
    },
    "-c --cfg": {
        "choices": ("job", "hydra", "all"),
        "help": "print the composed configuration and stop; hydra, all: with Hydra's part of it",
    },
    "--resolve": {"action": "store_true", "help": "with --cfg: print interpolated values"},
    "-p --package": {"metavar": "KEY", "help": "with --cfg: print a part, such as env"},
    "-cd --config-dir": {"metavar": "DIR", "help": "groups and files of your own beside ours"},
    "-cn --config-name": {"metavar": "FILE", "help": "another file than the script's own"},
    "-cp --config-path": {"metavar": "DIR", "help": "a folder in place of ours"},
    "-i --info": {
        "nargs": "?",
        "const": "all",
        "help": "print what the configuration is composed of: defaults-tree, searchpath, ...",
    },
    "-sc --shell-completion": {
        "action": "store_true",
        "help": 'tab completion: eval "$({command} -sc install=bash)"',
    },
    "-h --help": {"action": "store_true", "help": "print this and stop"},
    "--hydra-help": {"action": "store_true", "help": "print Hydra's own help and stop"},
    "-r --run": {"action": "store_true", "help": argparse.SUPPRESS},
    "--version": {"action": "store_true", "help": "print the versions and stop"},
    "overrides": {"nargs": "*", "help": argparse.SUPPRESS},
}


def run_command(script: scripts.Script, argv: list[str] | None = None) -> int:
    """Parses, composes, checks and runs. Returns the exit code."""
    warnings.showwarning, arguments = console.warn, sys.argv[:]
    words = sys.argv[1:] if argv is None else argv
    try:
        words = [script.reword(without_dashes(word)) for word in words]
        ending = endings.ending_of(lambda: _run(script, words))
    finally:
        sys.argv[:] = arguments
    if ending.text:
        console.say(f"{package.command(script.name)}: {ending.text}", sys.stderr)
    return ending.code


def without_dashes(word: str) -> str:
    """Returns `--learner.lr=0.1`, as agents of W&B's sweeps write it, as `learner.lr=0.1`; options
    are left as they are.
    """
    name, is_given, _ = word.partition("=")
    options = {option for names in OPTIONS for option in names.split()}
    is_key = is_given and name.startswith("--") and name not in options
    return word.removeprefix("--") if is_key else word


def _run(script: scripts.Script, argv: list[str]) -> int:
    command = package.command(script.name, "python ")
    parser = argparse.ArgumentParser(
        package.command(script.name),
        f"{command} [-m] [key=value ...]",
        script.help,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        add_help=False,
        allow_abbrev=False,
    )
    for names, arguments in OPTIONS.items():
        arguments = arguments | {"help": arguments["help"].replace("{command}", command)}
        parser.add_argument(*names.split(), **arguments)
    options = parser.parse_intermixed_args(argv)
    if options.version:
        console.say(f"{package.version()}, Hydra {hydra.__version__}")
        return 0
    composer = compose.Composer(
        script, options.config_name, options.config_dir, options.config_path
    )
    flags = [one for one in argv if one not in (*options.overrides, "-m", "--multirun")]
    words = [word.replace("hydra.run.dir=", "folder=") for word in options.overrides]
    if options.help:
        parser.epilog = "groups, chosen with group=member:" + "".join(
            f"\n  {name:<11} {', '.join(members)}" for name, members in composer.groups().items()
        )
        console.say(parser.format_help().rstrip())
    elif options.shell_completion:
        line = f"{os.environ.get('COMP_LINE', '')}|"  # whose last word is to be completed
        config, errors = composer.config(composer.parse(w for w in line.split()[:-1] if "=" in w))
        if not errors:  # nothing completes what follows words that are wrong
            tree = compose.own(config)
            keys = [f"{key}=null" for key, _ in check.fields_of(script.kind, tree)]
            _show(composer, OmegaConf.merge(OmegaConf.from_dotlist(keys), tree), flags + words)
    elif options.cfg:
        for i, job in enumerate(
            sweeps.jobs_of(composer, words)[0] if options.multirun else [words]
        ):
            print("---\n" * (i > 0), end="", flush=True)
            _show(composer, check.as_tree(composer.settings(job)), flags + job)
    elif options.info or options.hydra_help:
        with user_errors(kinds=compose.HYDRA_ERRORS):
            composer.call_hydra(flags + words)
    elif options.multirun or "hydra.mode=MULTIRUN" in words:
        return sweeps.sweep(composer, words)
    else:
        if "device=cpu" not in words:
            gpu.start_driver()  # beside composing
        with contextlib.nullcontext() if script is scripts.RECORD else rank.joined() as team:
            settings, config = rank.together(lambda: _checked(composer, words))
            if config.hydra.mode == RunMode.MULTIRUN:
                return sweeps.sweep(composer, words)
            if team is None and (settings.device != "auto" or gpu.is_available()):
                gpu.wake(settings.device)  # beside the imports of what runs
            if composer.note:
                console.say(composer.note)
            script.run(settings)
    return 0


def _checked(composer: compose.Composer, words: list[str]) -> tuple:
    """Returns settings that can be run, and the configuration they are from."""
    settings, config = composer.compose(words)
    if config.hydra.mode != RunMode.MULTIRUN:
        composer.script.ready(settings)
    return settings, config


def _show(composer: compose.Composer, tree: Any, arguments: list[str]) -> None:
    """Has Hydra show or complete a configuration that has every key there is."""
    node = {"defaults": [composer.name, "_self_"], **tree}
    compose.STORE.store(name="every-key", node=node)
    with user_errors(kinds=(OSError, ValueError, *compose.HYDRA_ERRORS)):
        composer.call_hydra([*arguments, "--config-name=every-key"])
