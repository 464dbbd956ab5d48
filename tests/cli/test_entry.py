"""The start of the scripts: the GPU wakes up while Python imports."""

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
def test_wants_first_gpu(words, wanted):
    assert entry.wants_first_gpu(words) == wanted


def test_cuda_context_without_driver(monkeypatch):
    def absent(name):
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(entry.ctypes, "CDLL", absent)
    assert entry.create_cuda_context() is None


@pytest.mark.cuda
def test_pytorch_uses_the_created_context():
    code = """
from megastep.agents.cli.entry import create_cuda_context
create_cuda_context()
import torch
assert torch.cuda.memory_allocated() == 0
assert (torch.ones(8, device="cuda") @ torch.ones(8, device="cuda")).item() == 8
"""
    subprocess.run([sys.executable, "-c", code], check=True)
