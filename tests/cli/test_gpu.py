"""Queues of the GPU's driver, which is asked for them before it starts."""

import os
import subprocess
import sys

import pytest
import torch

from megastep.agents.launch import gpu

#: Prints how many times as long as one stream 32 take that do the same, each on its own.
STREAMS = """
from megastep.agents.launch import gpu
assert gpu.is_available()
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


@pytest.fixture
def environment(monkeypatch):
    """The environment variables of a process whose driver has not started."""
    monkeypatch.setattr(os, "environ", os.environ.copy())
    os.environ.pop("CUDA_DEVICE_MAX_CONNECTIONS", None)
    return os.environ


@pytest.mark.parametrize("users, expected", [(None, "32"), ("4", "4")])
def test_queues_are_asked_for_before_the_driver_starts(environment, monkeypatch, users, expected):
    seen = []
    monkeypatch.setattr(
        torch.cuda, "is_available", lambda: seen.append(os.environ["CUDA_DEVICE_MAX_CONNECTIONS"])
    )
    if users:
        environment["CUDA_DEVICE_MAX_CONNECTIONS"] = users
    assert gpu.count() == 0 and seen == [expected]


@pytest.mark.cuda
def test_32_streams_run_side_by_side(environment):
    done = subprocess.run(
        [sys.executable, "-c", STREAMS], capture_output=True, text=True, env=environment, check=True
    )
    assert float(done.stdout) < 2  # 4 with the 8 queues of CUDA's
