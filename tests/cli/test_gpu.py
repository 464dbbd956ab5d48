"""GPUs are found before PyTorch is imported, at a stand-in for the driver."""

import os
import subprocess
import sys
import threading

import pytest

from megastep.agents.launch import gpu

#: Prints how many times as long as one stream 32 take that do the same, each on its own.
STREAMS = """
from megastep.agents.launch import gpu
gpu.start_driver()
gpu.wake("cuda")
import time, torch
streams = [torch.cuda.Stream() for _ in range(32)]
def seconds(n):
    torch.cuda.synchronize()
    start = time.perf_counter()
    for stream in streams[:n]:
        with torch.cuda.stream(stream):
            torch.cuda._sleep(20_000_000)
    torch.cuda.synchronize()
    return time.perf_counter() - start
seconds(32)
print(seconds(32) / seconds(1))
"""


class Driver:
    """CUDA's driver with some GPUs. `retained`: the GPUs whose context was created."""

    def __init__(self, n_gpus=4, version=12_040):
        self.n_gpus, self.version, self.retained = n_gpus, version, []

    def cuInit(self, flags):
        return 0 if self.n_gpus else 100  # CUDA_ERROR_NO_DEVICE

    def cuDriverGetVersion(self, result):
        result._obj.value = self.version

    def cuDeviceGetCount(self, result):
        result._obj.value = self.n_gpus

    def cuDeviceGet(self, result, index):
        result._obj.value = index
        return 0 if index < self.n_gpus else 101  # CUDA_ERROR_INVALID_DEVICE

    def cuDevicePrimaryCtxRetain(self, context, device):
        self.retained.append(device.value)


@pytest.fixture
def installed(monkeypatch):
    """Installs a driver and a PyTorch that is built for a version of CUDA."""

    def install(driver, built_for="12.6"):
        gpu.driver.cache_clear()
        monkeypatch.setattr(gpu.ctypes, "CDLL", lambda name: driver)
        monkeypatch.setattr(gpu.runpy, "run_path", lambda path: {"cuda": built_for})
        return driver

    yield install
    gpu.driver.cache_clear()


@pytest.fixture
def environment(monkeypatch):
    """The environment variables of a process whose driver has not started."""
    monkeypatch.setattr(os, "environ", os.environ.copy())
    os.environ.pop("CUDA_DEVICE_MAX_CONNECTIONS", None)
    return os.environ


@pytest.mark.parametrize(
    "n_gpus, version, built_for, available",
    [
        (1, 12_040, "12.6", True),
        (1, 13_000, "12.6", True),
        (1, 11_080, "12.6", False),
        (0, 12_040, "12.6", False),
        (1, 12_040, None, False),
    ],
)
def test_is_available_without_pytorch(
    installed, monkeypatch, n_gpus, version, built_for, available
):
    installed(Driver(n_gpus, version), built_for)
    monkeypatch.delitem(sys.modules, "torch")
    assert gpu.is_available() == available and "torch" not in sys.modules


def test_no_driver(monkeypatch, installed):
    installed(None)

    def absent(name):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(gpu.ctypes, "CDLL", absent)
    assert gpu.driver() is None
    gpu.wake("cuda")


def contexts(driver):
    """Returns the GPUs with a context, once all threads are through."""
    for thread in set(threading.enumerate()) - {threading.main_thread()}:
        thread.join(timeout=10)
    return driver.retained


@pytest.mark.parametrize(
    "device, woken", [("auto", [0]), ("cuda", [0]), ("cuda:3", [3]), ("cpu", []), ("cuda:9", [])]
)
def test_wakes_its_own_gpu(installed, device, woken):
    driver = installed(Driver())
    gpu.wake(device)
    assert contexts(driver) == woken


@pytest.mark.cuda
def test_pytorch_uses_the_created_context():
    code = """
from megastep.agents.launch import gpu
assert gpu.is_available()
gpu.wake("cuda")
import torch
assert torch.cuda.memory_allocated() == 0
assert (torch.ones(8, device="cuda") @ torch.ones(8, device="cuda")).item() == 8
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("users, expected", [(None, "32"), ("4", "4")])
def test_queues_are_asked_for_before_the_driver_starts(environment, installed, users, expected):
    seen, driver = [], installed(Driver())
    driver.cuInit = lambda flags: seen.append(os.environ["CUDA_DEVICE_MAX_CONNECTIONS"]) or 0
    if users:
        environment["CUDA_DEVICE_MAX_CONNECTIONS"] = users
    assert gpu.driver() is driver
    assert seen == [expected]


@pytest.mark.cuda
def test_32_streams_run_side_by_side(environment):
    done = subprocess.run(
        [sys.executable, "-c", STREAMS], capture_output=True, text=True, env=environment, check=True
    )
    assert float(done.stdout) < 2  # 4 with the 8 queues of CUDA's
