"""The door: command line -> Hydra -> checked settings. Everything is composed and checked before
anything is written.

Hydra is used through its compose API and its override grammar; `@hydra.main` would make its folder
first, and exit 1.
"""

import argparse
import dataclasses
import signal
import sys
import time
import warnings
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from configs import runs
from configs.console import say, table, warn
from configs.interruptions import Interrupted
from configs.settings import Fault, Faults, build, closest, closest_key

CONFIGS = Path(__file__).resolve().parent


class Door:
    """Composes and checks the configuration of one script; a context, as Hydra keeps its state in a
    global.
    """

    def __init__(self, script, kind):
        self.script, self.kind = script, kind

    def __enter__(self):
        GlobalHydra.instance().clear()
        self._context = initialize_config_dir(
            str(CONFIGS), version_base="1.3", job_name=self.script
        )
        self._context.__enter__()
        return self

    def __exit__(self, *error):
        return self._context.__exit__(*error)

    def groups(self):
        """{group: [members]}; train.yaml and its fellows are no groups."""
        loader = GlobalHydra.instance().config_loader()
        chosen = self._compose([], hydra=True).hydra.runtime.choices
        return {
            g: loader.get_group_options(g)
            for g in loader.get_group_options("", ObjectType.GROUP)
            if g in chosen
        }

    def jobs(self, overrides, multirun=False):
        """The composed tree of each job, `[(overrides, nested dict)]`; one job unless multirun."""
        parsed = self._parsed(overrides, multirun)
        if not multirun:
            return [(overrides, self.tree(overrides))]
        try:
            batches = BasicSweeper.split_arguments(parsed, max_batch_size=None)[0]
        except HydraException as error:
            raise Fault(f"This sweep cannot be split: {error}") from None
        return [(list(job), self.tree(list(job))) for job in batches]

    def tree(self, overrides):
        """Nested dicts for one list of overrides. Faults names every unknown key and group member,
        and bad value.
        """
        faults, fine, groups = [], [], self.groups()
        choices = [o for o in self._parsed(overrides) if o.key_or_group in groups]
        for choice in choices:
            member, members = choice.value(), groups[choice.key_or_group]
            if member is not None and member not in members:
                faults.append(
                    (choice.key_or_group, f"{member!r} is unknown; {closest(member, members)}")
                )
            else:
                fine.append(choice.input_line)
        keys = list(_paths(_plain(self._compose(fine))))
        for override in self._parsed(overrides):
            key = override.key_or_group
            if key in groups:
                continue
            if key in keys or any(k.startswith(key + ".") for k in keys):
                fine.append(override.input_line)
            else:
                faults.append((key, f"no such key; {closest_key(key, [*keys, *groups])}"))
        try:
            tree = _plain(self._compose(fine))
        except (HydraException, OmegaConfBaseException) as error:
            raise Faults([*faults, ("configuration", " ".join(str(error).split()))]) from None
        try:
            build(self.kind, tree)
        except Faults as error:
            faults += error.faults
        if faults:
            raise Faults(faults)
        return tree

    def _compose(self, overrides, hydra=False):
        """With a GPU to run on, `agent=auto` is replaced by `agent=large`; without one it is
        `small` already.
        """
        config = compose(self.script, overrides, return_hydra_config=True)
        if config.hydra.runtime.choices.get("agent") == "auto" and _has_gpu(config.get("device")):
            config = compose(self.script, [*overrides, "agent=large"], return_hydra_config=True)
        if not hydra:
            OmegaConf.set_struct(config, False)
            config.pop("hydra")
        return config

    def _parsed(self, overrides, multirun=False):
        faults, parsed = [], []
        for text in overrides:
            try:
                override = OverridesParser.create().parse_override(text)
            except HydraException:
                faults.append(
                    (
                        text,
                        "is not understood; write key=value, quote blanks and brackets: 'key=\"a "
                        "b\"'",
                    )
                )
                continue
            if override.type.name != "CHANGE" or override.package is not None:
                faults.append((text, "keys and groups are fixed; write key=value or group=member"))
            elif override.is_sweep_override() and not multirun:
                faults.append((override.key_or_group, f"{text!r} asks for several runs; add -m"))
            else:
                parsed.append(override)
        if faults:
            raise Faults(faults)
        return parsed


def _has_gpu(device):
    if device == "cpu":
        return False
    import torch

    return torch.cuda.is_available()


def _plain(config):
    return OmegaConf.to_container(config, resolve=True)


def _paths(tree, prefix=""):
    for key, value in tree.items():
        yield prefix + key
        if isinstance(value, dict):
            yield from _paths(value, f"{prefix}{key}.")


def main(script, kind, run, help_text, argv=None, prepare=lambda tree, overrides: tree):
    """Parses, composes, checks, runs; returns the exit code.

    `run(settings)` does the work; `prepare(tree, overrides)` may replace a composed tree before it
    is built.
    """
    signal.signal(signal.SIGTERM, _terminate)
    warnings.showwarning = lambda message, *_, **__: warn(message)
    try:
        with Door(script, kind) as door:
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
    except Fault as fault:
        say(f"{script}.py: {fault}", sys.stderr)
        return 2
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


def sweep(run, overrides, settings):
    """Runs the jobs one after the other, each in its own folder, past those that fail. Returns the
    exit code.
    """
    base = runs.fresh(Path("sweeps") / time.strftime("%Y-%m-%d_%H-%M-%S"))
    rows = []
    for number, (words, job) in enumerate(zip(overrides, settings)):
        label = ",".join(words).replace("/", "_") or "default"
        if hasattr(job, "folder"):
            job = dataclasses.replace(job, folder=str(base / f"{number}_{label[:100]}"))
        say(f"Job {number + 1} of {len(settings)}: {' '.join(words)}")
        start = time.monotonic()
        try:
            result = run(job)
            state = "done"
        except Interrupted:
            raise
        except Exception as error:  # whatever it is, the other jobs are worth running
            reason = str(error) if isinstance(error, Fault) else f"{type(error).__name__}: {error}"
            result, state = None, f"FAILED: {reason}"
            say(f"Job {number + 1} {state}", sys.stderr)
        rows.append(
            (
                str(number),
                " ".join(words),
                state,
                runs.headline(result),
                f"{time.monotonic() - start:.0f} s",
            )
        )
    say(table(("job", "overrides", "state", "return", "time"), rows, title="Sweep"))
    return 2 if any(row[2] != "done" for row in rows) else 0
