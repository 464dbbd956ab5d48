"""Fixtures and settings of all tests: one thread per process, no display, no GPU needed."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import ctypes
import subprocess
from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)


def pytest_collection_modifyitems(items):
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("cuda"):
                item.add_marker(pytest.mark.skip(reason="there is no GPU"))


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request):
    """Each device in turn, for tests that hold on both."""
    return request.param


@pytest.fixture(scope="session")
def launch_on_cpu(tmp_path_factory):
    """A stand-in for `launch` that runs the learner's CUDA kernels on a CPU.

    Their source is compiled for the CPU through `cuda_on_cpu.h`.
    """
    from megastep.agents.networks.kernels.program import CORES
    from megastep.kernels.build import compile

    folder = tmp_path_factory.mktemp("kernels")
    source, library = folder / "kernels.cpp", folder / "kernels.so"
    files = [Path(__file__).parent / "helpers" / "cuda_on_cpu.h", *CORES.folder.glob("*.cu")]
    lines = [f'#include "{path}"' for path in files]
    lines += [
        f'extern "C" void run_{operation}(const {struct}* p, unsigned int threads) '
        f"{{ launch({operation}, p, threads); }}"
        for operation, struct in CORES.cuda_operations.items()
    ]
    source.write_text("\n".join(lines))
    command = [compile.compiler()[0], "-std=c++17", "-O1", "-shared", "-fPIC"]
    command += [f"-I{compile.KERNELS}", str(source), "-o", str(library)]
    subprocess.run(command, check=True)
    loaded = ctypes.CDLL(str(library))

    def launch(program, operation, packed, device, threads):
        assert program is CORES and device.type == "cpu"
        getattr(loaded, f"run_{operation}")(packed, ctypes.c_uint(threads))

    return launch
