"""Runs a command: options, help, exit codes."""

import argparse
import contextlib
import dataclasses
import importlib
import sys
import warnings
from collections.abc import Callable
from typing import Any

from megastep.agents import console, package
from megastep.agents.errors import ConfigErrors, user_errors
from megastep.agents.factory import check
from megastep.agents.launch import endings, rank
from megastep.agents.runs import folders, populations

#: Options of commands that files configure, which are Hydra's: names, and argparse's arguments.
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
    "-cd --config-dir": {"metavar": "DIR", "help": "groups and files of your own beside ours"},
    "-cn --config-name": {"metavar": "FILE", "help": "another file than the script's own"},
    "-i --info": {
        "nargs": "?",
        "const": "all",
        "help": "print what the configuration is composed of: defaults-tree, searchpath, ...",
    },
}
#: Options of every command.
COMMON = {
    "-h --help": {"action": "store_true", "help": "print this and stop"},
    "--version": {"action": "store_true", "help": "print the versions and stop"},
    "overrides": {"nargs": "*", "help": argparse.SUPPRESS},
}


@dataclasses.dataclass(frozen=True)
class Command:
    """A command of the package. Its module, `agents/cli/NAME.py`, has `run(cfg)`.

    Attributes:
        name: of the command, its module, and the file of its configuration.
        kind: the dataclass of its settings.
        help: the head of --help.
        has_files: files in configs/ configure it.
        prepare: changes the composed tree before it is checked, given the typed keys.
        ready: raises UserError for checked settings that cannot be run here.
        has_ranks: torchrun may start it.
    """

    name: str
    kind: type
    help: str
    has_files: bool = False
    prepare: Callable[[check.Tree, list[str]], check.Tree] = lambda tree, typed: tree
    ready: Callable[[Any], None] = lambda cfg: None
    has_ranks: bool = False

    def run(self, cfg: Any) -> Any:
        return importlib.import_module(f"megastep.agents.cli.{self.name}").run(cfg)

    def main(self, words: list[str] | None = None) -> int:
        """Runs the command with words, by default those of this process. Returns the exit code."""
        warnings.showwarning, arguments = console.warn, sys.argv[:]
        words = sys.argv[1:] if words is None else words
        try:
            ending = endings.ending_of(lambda: _run(self, [*map(without_dashes, words)]))
        finally:
            sys.argv[:] = arguments
        if ending.text:
            console.say(f"{package.command(self.name)}: {ending.text}", sys.stderr)
        return ending.code


def without_dashes(word: str) -> str:
    """Returns `--learner.lr=0.1`, as W&B's agents write it, as `learner.lr=0.1`; options as they
    are.
    """
    name, is_given, _ = word.partition("=")
    is_option = name in " ".join(OPTIONS).split()
    return word.removeprefix("--") if is_given and not is_option else word


def _run(command: Command, argv: list[str]) -> int:
    script = package.command(command.name, "python ")
    parser = argparse.ArgumentParser(
        package.command(command.name),
        f"{script} {'[-m] ' * command.has_files}[key=value ...]",
        command.help,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        add_help=False,
        allow_abbrev=False,
    )
    for names, arguments in {**(OPTIONS if command.has_files else {}), **COMMON}.items():
        parser.add_argument(*names.split(), **arguments)
    options = parser.parse_intermixed_args(argv)
    if options.version:
        console.say(package.version())
        return 0
    if command.has_files:
        return _run_composed(command, options, argv, parser)
    is_needed = any(field.is_required() for field in command.kind.__pydantic_fields__.values())
    if options.help or (is_needed and not argv):
        console.say(parser.format_help().rstrip())
        return 0 if options.help else 2
    from megastep.agents.cli import words

    result = command.run(words.plain_settings(command, options.overrides))
    return result if isinstance(result, int) else 0


def _run_composed(command, options, argv, parser) -> int:
    """Runs a command that files configure. Returns the exit code."""
    from megastep.agents.cli import compose, sweeps

    composer = compose.Composer(command, options.config_name, options.config_dir)
    words = [word.replace("hydra.run.dir=", "folder=") for word in options.overrides]
    if options.help:
        parser.epilog = "groups, chosen with group=member:" + "".join(
            f"\n  {name:<11} {', '.join(members)}" for name, members in composer.groups().items()
        )
        console.say(parser.format_help().rstrip())
    elif options.cfg == "job":
        jobs = sweeps.jobs_of(composer, words)[0] if options.multirun else [words]
        for i, job in enumerate(jobs):
            print("---\n" * (i > 0), end="", flush=True)
            tree = check.as_tree(composer.settings(job))
            print(compose.OmegaConf.to_yaml(tree), end="", flush=True)
    elif options.cfg or options.info:
        flags = [one for one in argv if one not in (*options.overrides, "-m", "--multirun")]
        with user_errors(kinds=compose.HYDRA_ERRORS):
            composer.call_hydra(flags + words)
    elif options.multirun:
        return sweeps.sweep(composer, words)
    else:
        with rank.joined() if command.has_ranks else contextlib.nullcontext():
            cfg = rank.together(lambda: _ready(composer, words))
            if cfg is None:
                return sweeps.sweep(composer, words)
            command.run(cfg)
    return 0


def _ready(composer, words) -> Any:
    """Returns settings that can be run; None if files say that this is a sweep."""
    cfg, config = composer.compose(words)
    if config.hydra.mode is not None and config.hydra.mode.name == "MULTIRUN":
        return None
    composer.command.ready(cfg)
    return cfg


def load(name: str) -> Command:
    """Returns the command of this name."""
    return importlib.import_module(f"megastep.agents.cli.{name}").COMMAND


def with_member(tree: check.Tree, key: str) -> check.Tree:
    """Returns the tree with the folder of a population's member at a key, in place of the
    population's and of `member`. Raises ConfigErrors if there is no such member.
    """
    run, member = tree.get(key), tree.get("member")
    if member is None or not isinstance(run, str):
        return tree
    root = folders.find(run, None)
    if not populations.is_root(root):
        raise ConfigErrors([("member", f"is of a population, and {run} is a single run")])
    if member != "best" and type(member) is not int:
        raise ConfigErrors([("member", f"{member!r} is neither a number nor best")])
    return tree | {key: str(populations.member(root, member)), "member": None}
