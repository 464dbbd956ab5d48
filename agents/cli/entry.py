"""Starts train, evaluate, record and reproduce: as scripts, as the command `megastep`, or with
`python -m megastep`. Signals and closed streams are handled before anything else is imported.
"""

import os
import sys
import threading

from megastep.agents import package
from megastep.agents.errors import UserError
from megastep.agents.launch import signals

SCRIPTS = {
    "train": "trains a policy",
    "evaluate": "measures a trained policy",
    "record": "films a trained policy",
    "reproduce": "lists the results in docs/lab; makes one again",
}
#: Commands about one run, which is their argument.
ON_RUNS = {
    "inspect": "verifies a run's checkpoints and prints what is in them",
    "rerun": "repeats a run and compares its metrics, byte for byte",
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
            print(" ".join(name for name in SCRIPTS | ON_RUNS if name.startswith(script)))
            words = [""]
    if words[0] == "rerun" and len(words) > 1:
        words = ["train", f"rerun={words[1]}", *words[2:]]
    if words[0] in SCRIPTS:
        sys.argv[1:] = words[1:]
        return run_script(words[0])
    if words[0] == "inspect":
        return inspect_run(words[1:])
    from megastep.agents import console
    from megastep.settings import closest

    console.open_streams()
    if words[0] in ("-h", "--help"):
        for name, text in SCRIPTS.items():
            console.say(f"  {package.command(name, 'python -m '):<28}{text}; --help says more")
        for name, text in ON_RUNS.items():
            console.say(f"  {package.command(name, 'python -m '):<28}{text}")
        console.say("Benchmarks and sheets of homes are in scripts/ of the repository.")
    elif words[0] == "--version":
        console.say(package.version())
    elif words[0] in IN_A_CLONE:
        text = f"{words[0]} needs a clone of the repository: {IN_A_CLONE[words[0]]}"
        console.say(f"megastep: {text}", sys.stderr)
        return 2
    elif words[0]:
        console.say(
            f"megastep: {words[0]!r} is unknown; {closest(words[0], [*SCRIPTS, *ON_RUNS])}",
            sys.stderr,
        )
        return 2
    return 0


def run_script(name: str) -> int:
    """Runs a script of this package by its name. Returns the exit code."""
    signals.exit_on_signals(name)
    from megastep.agents import console

    console.open_streams()
    threading.excepthook = console.warn_of_thread
    if name == "reproduce":
        from megastep.agents.cli import reproduce

        return reproduce.main(sys.argv[1:])
    from megastep.agents.cli import command, scripts

    return command.run_command(scripts.SCRIPTS[name])


def inspect_run(words: list[str]) -> int:
    """Runs `megastep inspect`. Returns the exit code."""
    signals.exit_on_signals("inspect")
    from megastep.agents import console
    from megastep.agents.cli import inspect

    console.open_streams()
    try:
        return inspect.run(words)
    except UserError as error:
        console.say(f"megastep inspect: {error}", sys.stderr)
        return error.code
