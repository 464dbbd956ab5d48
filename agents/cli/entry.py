"""Starts train, evaluate and record: as scripts, as the command `megastep`, or with `python -m
megastep`. Signals and closed streams are handled before anything else is imported.
"""

import importlib
import os
import sys
import threading

from megastep.agents.cli import program, signals

SCRIPTS = {
    "train": "trains a policy",
    "evaluate": "measures a trained policy",
    "record": "films a trained policy",
}
#: Commands without a configuration of their own: modules of this package with a `main(words)`.
COMMANDS = {
    "replay": "shows a run's NaN again",
}
#: What only a clone of the repository has, and what runs it there.
IN_A_CLONE = {
    "bench": "python scripts/benchmarks/benchmark.py step",
    "show": "python scripts/show_homes.py homes.png",
}


def main() -> int:
    """Runs the installed command, `megastep`. Returns the exit code."""
    words, line = sys.argv[1:] or ["--help"], os.environ.get("COMP_LINE", "")
    if words[0] in ("-sc", "--shell-completion"):
        script = "".join(line.split()[1:2])  # which is completed here, its options elsewhere
        if "query=" not in " ".join(words):
            words = ["train", *words]
        elif script and (len(line.split()) > 2 or line.endswith(" ")):
            os.environ["COMP_LINE"] = line.replace(script, "", 1)
            words = [script, *words]
        else:
            print(" ".join(name for name in SCRIPTS | COMMANDS if name.startswith(script)))
            words = [""]
    if words[0] in SCRIPTS:
        sys.argv[1:] = words[1:]
        return run_script(words[0])
    if words[0] in COMMANDS:
        sys.argv[1:] = words[1:]
        return run_module(words[0])
    from megastep.agents.cli import console
    from megastep.settings import closest

    console.open_streams()
    if words[0] in ("-h", "--help"):
        for name, text in (SCRIPTS | COMMANDS).items():
            console.say(f"  {program.name(name, 'python -m '):<28}{text}; --help says more")
        console.say("Benchmarks and sheets of homes are in scripts/ of the repository.")
    elif words[0] == "--version":
        console.say(program.version())
    elif words[0] in IN_A_CLONE:
        text = f"{words[0]} needs a clone of the repository: {IN_A_CLONE[words[0]]}"
        console.say(f"megastep: {text}", sys.stderr)
        return 2
    elif words[0]:
        console.say(
            f"megastep: {words[0]!r} is unknown; {closest(words[0], SCRIPTS | COMMANDS)}",
            sys.stderr,
        )
        return 2
    return 0


def run_script(name: str) -> int:
    """Runs a script of this package by its name. Returns the exit code."""
    prepare(name)
    from megastep.agents.cli import command, scripts

    return command.run_command(scripts.SCRIPTS[name])


def run_module(name: str) -> int:
    """Runs a command of `COMMANDS` by its name. Returns the exit code."""
    prepare(name)
    return importlib.import_module(f"megastep.agents.cli.{name}").main()


def prepare(name: str) -> None:
    """Handles signals, closed streams and threads that fail."""
    signals.exit_on_signals(name)
    from megastep.agents.cli import console  # its imports take a while

    console.open_streams()
    threading.excepthook = console.warn_of_thread
