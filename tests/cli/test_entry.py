"""What the scripts begin with."""

import subprocess
import sys

import pytest

from megastep.agents.cli import entry


@pytest.mark.parametrize(
    "words, wanted",
    [
        ([], True),
        (["env=minimal", "device=auto"], True),
        (["device=cuda:0"], True),
        (["device=cuda:1"], False),
        (["device=cpu"], False),
        (["-m", "device=cpu,cuda"], False),
        (["--help"], False),
        (["--cfg", "job"], False),
    ],
)
def test_the_first_gpu_wakes_up_unless_another_device_is_named(words, wanted):
    assert entry.wants_first_gpu(words) == wanted


def test_without_a_driver_nothing_happens(monkeypatch):
    def absent(name):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(entry.ctypes, "CDLL", absent)
    assert entry.create_cuda_context() is None


@pytest.mark.cuda
def test_pytorch_works_in_the_context_that_was_created():
    code = """
from megastep.agents.cli.entry import create_cuda_context
create_cuda_context()
import torch
assert torch.cuda.memory_allocated() == 0
assert (torch.ones(8, device="cuda") @ torch.ones(8, device="cuda")).item() == 8
"""
    subprocess.run([sys.executable, "-c", code], check=True)
