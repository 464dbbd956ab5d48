"""Starts train, evaluate and record, as scripts or as the command `megastep`.

The GPU wakes up while Python imports; signals and closed streams are handled before that.
"""

import contextlib
import ctypes
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
#: Options that need no GPU in this process: they print something, or start jobs elsewhere.
WITHOUT_GPU = (
    "-h",
    "--h",
    "-c",
    "--cfg",
    "-i",
    "--info",
    "-s",
    "--shell",
    "--version",
    "-m",
    "--m",
)


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
            print(" ".join(name for name in SCRIPTS if name.startswith(script)))
            words = [""]
    if words[0] in SCRIPTS:
        sys.argv[1:] = words[1:]
        return run_script(words[0])
    from megastep.agents.cli import console
    from megastep.settings import closest

    console.open_streams()
    if words[0] in ("-h", "--help"):
        for name, text in SCRIPTS.items():
            console.say(f"  megastep {name:<10}{text}; --help says more")
    elif words[0] == "--version":
        console.say(program.version())
    elif words[0]:
        console.say(f"megastep: {words[0]!r} is unknown; {closest(words[0], SCRIPTS)}", sys.stderr)
        return 2
    return 0


def run_script(name: str) -> int:
    """Runs a script of this package by its name. Returns the exit code."""
    signals.exit_on_signals(name)
    if wants_first_gpu(sys.argv[1:]):
        # the interpreter waits for this thread: a process must not end within the driver
        threading.Thread(target=create_cuda_context).start()
    from megastep.agents.cli import console  # its imports take a while, too

    console.open_streams()
    threading.excepthook = console.warn_of_thread
    return importlib.import_module(f"megastep.agents.cli.{name}").main()


def wants_first_gpu(words: list[str]) -> bool:
    """Returns whether a command line may use the first GPU in this process."""
    devices = {word.partition("=")[2] for word in words if word.startswith("device=")}
    is_elsewhere = any(word.startswith(WITHOUT_GPU) for word in words)
    return devices <= {"auto", "cuda", "cuda:0"} and not is_elsewhere


def create_cuda_context() -> None:
    """Creates the primary context of the first GPU, if there is one; PyTorch finds it there later.

    It takes half a second in the driver, which passes beside Python's imports.
    """
    device, context = ctypes.c_int(), ctypes.c_void_p()
    with contextlib.suppress(OSError):  # no driver
        driver = ctypes.CDLL("libcuda.so.1")
        if driver.cuInit(0) == 0 and driver.cuDeviceGet(ctypes.byref(device), 0) == 0:
            driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), device)
