"""Starts commands. Signals and closed streams are handled before anything else is imported."""

import importlib
import sys

from megastep.agents import package
from megastep.agents.errors import UserError
from megastep.agents.launch import signals

#: The commands, each a module of this package with `main(words) -> int`, the exit code, but for
#: `rerun`, which is `train rerun=`.
COMMANDS = {
    "train": "trains a policy; --help says more",
    "evaluate": "measures a trained policy; --help says more",
    "record": "films a trained policy; --help says more",
    "dump": "writes episodes as a dataset: npz, Minari, LeRobot; --help says more",
    "report": "writes a page about a run or several: curves, evaluations, homes; --help says more",
    "compare": "draws a metric of several runs, averaged over seeds; --help says more",
    "web": "writes a page that plays an agent in a browser; --help says more",
    "export": "writes an agent for ONNX, torch.export, or in one file; --help says more",
    "reproduce": "lists the results in docs/lab; makes one again; --help says more",
    "import": "imports floor plans: CubiCasa5k, HouseExpo, your own; --help says more",
    "check": "checks the floor plans of a file: closed, reachable, ...; --help says more",
    "inspect": "verifies a run's checkpoints and prints what is in them",
    "rerun": "repeats a run and compares its metrics, byte for byte",
}


def main() -> int:
    """Runs the installed command, `megastep`. Returns the exit code."""
    name, *words = sys.argv[1:] or ["--help"]
    if name in COMMANDS:
        return run_command(name, words)
    from megastep.agents import console
    from megastep.settings import closest

    console.open_streams()
    if name == "--version":
        console.say(package.version())
    elif name in ("-h", "--help"):
        names = {package.command(name, "python -m "): text for name, text in COMMANDS.items()}
        for name, text in names.items():
            console.say(f"  {name:<{max(map(len, names))}}  {text}")
        console.say("Benchmarks and sheets of homes are in scripts/ of the repository.")
    else:
        console.say(f"megastep: {name!r} is unknown; {closest(name, COMMANDS)}", sys.stderr)
        return 2
    return 0


def run_command(name: str, words: list[str] | None = None) -> int:
    """Runs a command, by default with the words of this process. Returns the exit code."""
    sys.argv[1:] = words = sys.argv[1:] if words is None else words
    signals.exit_on_signals(name)
    from megastep.agents import console

    console.open_streams()
    try:
        if name == "rerun":
            if not words:
                raise UserError("takes a run: its folder, or latest")
            name, words = "train", [f"rerun={words[0]}", *words[1:]]
        return importlib.import_module(f"megastep.agents.cli.{name}").main(words)
    except UserError as error:
        console.say(f"{package.command(name)}: {error}", sys.stderr)
        return error.code
