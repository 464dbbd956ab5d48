"""Finds GPUs through NVIDIA's driver, since importing PyTorch takes seconds."""

import contextlib
import ctypes
import functools
import importlib.util
import os
import runpy
import sys
import threading
from pathlib import Path


def ask_for_queues() -> None:
    """Has the driver make 32 queues for streams instead of 8, unless the user says how many: a
    population has a stream for each member, and streams that share a queue wait for each other.
    Call it before the driver starts.
    """
    os.environ.setdefault("CUDA_DEVICE_MAX_CONNECTIONS", "32")


@functools.cache
def driver() -> ctypes.CDLL | None:
    """Returns the initialised driver library; None without a driver or a GPU."""
    ask_for_queues()  # for every command, as the driver starts before settings are known
    with contextlib.suppress(OSError):
        library = ctypes.CDLL("libcuda.so.1")
        if library.cuInit(0) == 0:
            return library
    return None


def start_driver() -> None:
    """Initialises the driver in a thread, while this process imports modules."""
    # not a daemon: the process must not exit inside the driver
    threading.Thread(target=driver).start()


def is_available() -> bool:
    """Returns the same as `torch.cuda.is_available`, without importing PyTorch."""
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
    """Creates a GPU's CUDA context in a thread; PyTorch uses it later. Saves half a second, as the
    driver works while Python imports modules.

    Args:
        device: such as `cuda` or `cuda:1`; nothing happens for `cpu`.
    """
    if device != "cpu":
        index = int(device.partition(":")[2] or 0)
        threading.Thread(target=_create_context, args=(index,)).start()


def _create_context(index) -> None:
    device, context = ctypes.c_int(), ctypes.c_void_p()
    library = driver()
    if library and library.cuDeviceGet(ctypes.byref(device), index) == 0:
        library.cuDevicePrimaryCtxRetain(ctypes.byref(context), device)
