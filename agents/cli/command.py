"""What train.py, evaluate.py and record.py do with a command line: parse, compose, check, run, exit
code.
"""

import argparse
import signal
import sys
import warnings

from omegaconf import OmegaConf

from agents.cli.build import build
from agents.cli.compose import ConfigLoader
from agents.cli.console import say, warn
from agents.cli.errors import UserError
from agents.cli.signals import Interrupted
from agents.cli.sweep import sweep


def run_command(script, kind, run, help_text, argv=None, prepare=lambda tree, overrides: tree):
    """Parses, composes, checks, runs; returns the exit code.

    `run(settings)` does the work; `prepare(tree, overrides)` may replace a composed tree before it
    is built.
    """
    signal.signal(signal.SIGTERM, _terminate)
    warnings.showwarning = lambda message, *_, **__: warn(message)
    try:
        with ConfigLoader(script, kind) as door:
            options = _options(script, sys.argv[1:] if argv is None else argv)
            if options.help:
                say(_help(script, door.groups(), help_text))
                return 0
            jobs = door.jobs(options.overrides, options.multirun)
            jobs = [(overrides, prepare(tree, overrides)) for overrides, tree in jobs]
            settings = [build(kind, tree) for _, tree in jobs]
        if options.cfg:
            say("\n---\n".join(OmegaConf.to_yaml(tree) for _, tree in jobs))
            return 0
        if options.multirun:
            return sweep(run, [overrides for overrides, _ in jobs], settings)
        run(settings[0])
        return 0
    except UserError as error:
        say(f"{script}.py: {error}", sys.stderr)
        return error.code
    except Interrupted as stop:
        say(str(stop), sys.stderr)
        return 128 + stop.number
    except KeyboardInterrupt:
        say(f"{script}.py: interrupted", sys.stderr)
        return 130


def _terminate(number, frame):
    raise Interrupted(number, "Terminated.")


def _options(script, argv):
    usage = f"{script}.py [-m] [key=value ...]; --help says more"
    parser = argparse.ArgumentParser(prog=f"{script}.py", add_help=False, usage=usage)
    parser.add_argument("-h", "--help", action="store_true")
    parser.add_argument("-m", "--multirun", action="store_true")
    parser.add_argument("-c", "--cfg", choices=["job"])
    parser.add_argument("overrides", nargs="*")
    return parser.parse_intermixed_args(argv)


def _help(script, groups, text):
    width = max(len(g) for g in groups)
    members = "\n".join(
        f"  {group:<{width}}  {', '.join(options)}" for group, options in groups.items()
    )
    return f"""{text}

python {script}.py [-m] [key=value ...]

Groups, chosen with group=member:
{members}

  -m, --multirun  run every combination of comma-separated values, one after the other: -m seed=1,2
  -c, --cfg job   print the composed configuration and stop
  -h, --help      this text"""
