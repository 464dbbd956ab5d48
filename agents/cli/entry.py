"""What train, evaluate and record begin with, as scripts or as `megastep train`: the GPU wakes up
while Python imports, and signals and closed streams are taken care of before that.
"""

import ctypes
import importlib
import os
import sys
import threading

from megastep.agents.cli import doors, signals

SCRIPTS = {
    "train": "trains a policy",
    "evaluate": "measures a trained policy",
    "record": "films a trained policy",
}
#: Options that print something and stop.
PRINTING = ("-h", "--h", "-c", "--cfg", "-i", "--info", "-s", "--shell", "--version", "--resolve")
SWEEPING = ("-m", "--multirun")


def main() -> int:
    """The installed command, `megastep`; returns the exit code."""
    command, *words = sys.argv
    if words and words[0] in ("-sc", "--shell-completion"):
        words = _completed(words)
    if words and words[0] in SCRIPTS:
        sys.argv = [command, *words[1:]]
        return run_script(words[0])
    from megastep.agents.cli import console
    from megastep.settings import closest

    console.open_streams()
    if words == ["--version"]:
        console.say(doors.version())
        return 0
    if words and words[0] not in ("-h", "--help", ""):
        console.say(f"megastep: {words[0]!r} is unknown; {closest(words[0], SCRIPTS)}", sys.stderr)
        return 2
    if not words or words[0]:
        lines = [f"  megastep {name:<10}{what}; --help says more" for name, what in SCRIPTS.items()]
        console.say("\n".join(lines))
    return 0


def _completed(words: list[str]) -> list[str]:
    """What completes a line that a shell has in COMP_LINE: the script that the line is for, and its
    options. Completes the script's own name itself; then nothing is left to do: ["" ].
    """
    line = os.environ.get("COMP_LINE", "")
    typed = line.split()[1:2]
    if not any(word.startswith("query=") for word in words):
        return ["train", *words]
    if typed and len(line.split()) > 2 or typed and line.endswith(" "):
        os.environ["COMP_LINE"] = line.replace(typed[0], "", 1)
        return [typed[0], *words]
    print(" ".join(name for name in SCRIPTS if name.startswith("".join(typed))))
    return [""]


def run_script(name: str) -> int:
    """Runs a script of this package by its name; returns the exit code."""
    signals.exit_on_signals(name)
    waking = threading.Thread(target=create_cuda_context)
    if wants_first_gpu(sys.argv[1:]):
        waking.start()  # the interpreter waits for it: a process must not end within the driver
    from megastep.agents.cli import console  # its imports take a while, too

    console.open_streams()
    threading.excepthook = console.warn_of_thread
    return importlib.import_module(f"megastep.agents.cli.{name}").main()


def wants_first_gpu(words: list[str]) -> bool:
    """Whether a command line may lead to work on the first GPU in this process: no other device is
    named in it.
    """
    devices = [word.partition("=")[2] for word in words if word.startswith("device=")]
    elsewhere = any(word.startswith(PRINTING) or word in SWEEPING for word in words)
    return not elsewhere and all(name in ("auto", "cuda", "cuda:0") for name in devices)


def create_cuda_context() -> None:
    """Creates the primary context of the first GPU, which PyTorch then finds there: half a second
    that passes beside the imports, as the driver needs no Python. Without a driver or a GPU,
    nothing.
    """
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return
    device, context = ctypes.c_int(), ctypes.c_void_p()
    if driver.cuInit(0) == 0 and driver.cuDeviceGet(ctypes.byref(device), 0) == 0:
        driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), device)
