"""What train.py, evaluate.py and record.py begin with: the GPU wakes up while Python imports, and
signals and closed streams are taken care of before that.
"""

import ctypes
import importlib
import sys
import threading

from agents.cli import signals


def run_script(name: str) -> int:
    """Runs a script of this package by its name; returns the exit code."""
    signals.exit_on_signals(name)
    waking = threading.Thread(target=create_cuda_context)
    if wants_first_gpu(sys.argv[1:]):
        waking.start()  # the interpreter waits for it: a process must not end within the driver
    from agents.cli import console  # its imports take a while, too

    console.open_streams()
    threading.excepthook = console.warn_of_thread
    return importlib.import_module(f"agents.cli.{name}").main()


def wants_first_gpu(words: list[str]) -> bool:
    """Whether a command line may lead to work on the first GPU: no other device is named in it."""
    devices = [word.partition("=")[2] for word in words if word.startswith("device=")]
    only_prints = {"--help", "-h", "--cfg", "-c"} & set(words)
    return not only_prints and all(name in ("auto", "cuda", "cuda:0") for name in devices)


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
