"""Runs a command: options, help, settings, exit codes."""

import argparse
import contextlib
import dataclasses
import gc
import importlib
import sys
import warnings
from collections.abc import Callable
from typing import Any

from megastep.agents import console, package
from megastep.agents.errors import ConfigErrors
from megastep.agents.factory import check
from megastep.agents.launch import endings, rank
from megastep.agents.runs import folders, populations
from megastep.settings import settings_of


@dataclasses.dataclass
class Command:
    """A command of the package. Its module, `agents/cli/NAME.py`, has it as `COMMAND`."""

    name: str  # of the command, its module, and the file of its configuration
    run: Callable  # its arguments are the settings, unless `kind` is given
    help: str  # the head of --help
    kind: Any = None  # the dataclass of the settings that `run` takes, if configs/ has them
    #: Changes the composed tree before it is checked, given the typed keys.
    prepare: Callable[[check.Tree, list[str]], check.Tree] = lambda tree, typed: tree
    #: Raises UserError for checked settings that cannot be run here.
    ready: Callable[[Any], None] = lambda cfg: None
    has_ranks: bool = False  # torchrun may start it

    def __post_init__(self) -> None:
        self.has_files = self.kind is not None
        self.kind = self.kind or settings_of(self.run)

    def call(self, tree: check.Tree) -> Any:
        """Runs a command without files with these settings, once they are checked."""
        return self.run(**vars(check.check(self.kind, tree)))

    def main(self, words: list[str] | None = None) -> int:
        """Runs the command with words, by default those of this process. Returns the exit code."""
        warnings.showwarning, arguments = console.warn, sys.argv[:]
        words = sys.argv[1:] if words is None else words
        try:
            ending = endings.ending_of(lambda: self._run([*map(without_dashes, words)]))
        finally:
            sys.argv[:] = arguments
        if ending.text:
            console.say(f"{package.command(self.name)}: {ending.text}", sys.stderr)
        return ending.code

    def _run(self, argv) -> int:
        parser = self._parser()
        options = parser.parse_intermixed_args(argv)
        is_needed = any(field.is_required() for field in self.kind.__pydantic_fields__.values())
        if options.version:
            console.say(package.version())
            return 0
        if self.has_files:
            return self._run_composed(options, parser)
        if options.help or (is_needed and not argv):
            console.say(parser.format_help().rstrip())
            return 0 if options.help else 2
        from megastep.agents.cli import words

        result = self.call(words.plain_tree(self.kind, options.overrides))
        return result if isinstance(result, int) else 0

    def _parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(
            package.command(self.name),
            f"{package.command(self.name, 'python ')} {'[-m] ' * self.has_files}[key=value ...]",
            self.help,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            add_help=False,
            allow_abbrev=False,
        )
        option = parser.add_argument
        if self.has_files:
            sweep = "a sweep: -m seed=1,2,3; hydra/launcher=joblib runs jobs side by side, "
            sweep += "submitit_slurm on a cluster; hydra/sweeper=optuna searches "
            sweep += "learner.lr='interval(1e-4,1e-2)'; hydra.sweep.dir=FOLDER is where it goes"
            option("-m", "--multirun", action="store_true", help=sweep)
            cfg = "print the composed configuration and stop; hydra, all: with Hydra's part of it"
            option("-c", "--cfg", choices=("job", "hydra", "all"), help=cfg)
            beside = "groups and files of your own beside ours"
            option("-cd", "--config-dir", metavar="DIR", help=beside)
            other = "another file than the script's own"
            option("-cn", "--config-name", metavar="FILE", help=other)
        option("-h", "--help", action="store_true", help="print this and stop")
        option("--version", action="store_true", help="print the versions and stop")
        option("overrides", nargs="*", help=argparse.SUPPRESS)
        return parser

    def _run_composed(self, options, parser) -> int:
        """Runs a command that files configure. Returns the exit code."""
        from megastep.agents.cli import compose, sweeps

        composer = compose.Composer(self, options.config_name, options.config_dir)
        words = [word.replace("hydra.run.dir=", "folder=") for word in options.overrides]
        if options.help:
            parser.epilog = "groups, chosen with group=member:" + "".join(
                f"\n  {name:<11} {', '.join(members)}"
                for name, members in composer.groups().items()
            )
            console.say(parser.format_help().rstrip())
        elif options.cfg:
            jobs = sweeps.jobs_of(composer, words)[0] if options.multirun else [words]
            for i, job in enumerate(jobs):
                print("---\n" * (i > 0) + composer.printed(job, options.cfg), end="", flush=True)
        elif options.multirun:
            return sweeps.sweep(composer, words)
        else:
            with rank.joined() if self.has_ranks else contextlib.nullcontext():
                cfg = rank.together(lambda: self._settings(composer, words))
                if cfg is None:
                    return sweeps.sweep(composer, words)
                self.run(cfg)
        return 0

    def _settings(self, composer, words) -> Any:
        """Returns settings that can be run; None if files say that this is a sweep."""
        gc.disable()  # imports leave no garbage, and to look for it takes a tenth of the time
        try:
            cfg, config = composer.compose(words)
        finally:
            if not gc.get_freeze_count():
                gc.freeze()  # in no later collection, either
            gc.enable()
        if config.hydra.mode is not None and config.hydra.mode.name == "MULTIRUN":
            return None
        self.ready(cfg)
        return cfg


def without_dashes(word: str) -> str:
    """Returns `--learner.lr=0.1`, as W&B has it, as `learner.lr=0.1`; options as they are."""
    is_option = word.startswith(("--cfg=", "--config-dir=", "--config-name="))
    return word.removeprefix("--") if "=" in word and not is_option else word


def load(name: str) -> Command:
    """Returns the command of this name."""
    return importlib.import_module(f"megastep.agents.cli.{name}").COMMAND


def with_member(tree: check.Tree, key: str) -> check.Tree:
    """Returns the tree with a population's member at a key, in place of it and of `member`."""
    run, member = tree.get(key), tree.get("member")
    if member is None or not isinstance(run, str):
        return tree
    root = folders.find(run, None)
    if not folders.is_population(root):
        raise ConfigErrors([("member", f"is of a population, and {run} is a single run")])
    if member != "best" and type(member) is not int:
        raise ConfigErrors([("member", f"{member!r} is neither a number nor best")])
    return tree | {key: str(populations.member(root, member)), "member": None}
