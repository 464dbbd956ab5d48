"""The first look at GPUs, through NVIDIA's driver: PyTorch takes seconds to import."""

import contextlib
import ctypes
import functools
import importlib.util
import runpy
import sys
import threading
from pathlib import Path


@functools.cache
def driver() -> ctypes.CDLL | None:
    """Returns the initialised driver, or None if there is none or it finds no GPU."""
    with contextlib.suppress(OSError):
        library = ctypes.CDLL("libcuda.so.1")
        if library.cuInit(0) == 0:
            return library
    return None


def start_driver() -> None:
    """Initialises the driver in a thread, which takes a while."""
    # the interpreter waits for this thread: a process must not end within the driver
    threading.Thread(target=driver).start()


def is_available() -> bool:
    """Returns what `torch.cuda.is_available` does, without importing PyTorch."""
    if "torch" in sys.modules:
        return sys.modules["torch"].cuda.is_available()
    package = importlib.util.find_spec("torch")
    assert package is not None and package.origin is not None
    built_for = runpy.run_path(str(Path(package.origin).with_name("version.py")))["cuda"]
    library = driver()
    if not built_for or library is None:
        return False
    version, n_gpus = ctypes.c_int(), ctypes.c_int()
    library.cuDriverGetVersion(ctypes.byref(version))
    library.cuDeviceGetCount(ctypes.byref(n_gpus))
    return n_gpus.value > 0 and version.value // 1000 >= int(built_for.split(".")[0])


def count() -> int:
    """Returns the number of GPUs that PyTorch can use, without importing it."""
    if not is_available():
        return 0
    if "torch" in sys.modules:
        return sys.modules["torch"].cuda.device_count()
    n_gpus, library = ctypes.c_int(), driver()
    assert library is not None
    library.cuDeviceGetCount(ctypes.byref(n_gpus))
    return n_gpus.value


def wake(device: str) -> None:
    """Creates the context of the GPU that is called `device`, if it is one, in a thread. PyTorch
    finds it there later.

    It takes half a second in the driver, which passes beside Python's imports.
    """
    if device != "cpu":
        index = int(device.partition(":")[2] or 0)
        threading.Thread(target=_create_context, args=(index,)).start()


def _create_context(index) -> None:
    device, context = ctypes.c_int(), ctypes.c_void_p()
    library = driver()
    if library and library.cuDeviceGet(ctypes.byref(device), index) == 0:
        library.cuDevicePrimaryCtxRetain(ctypes.byref(context), device)
