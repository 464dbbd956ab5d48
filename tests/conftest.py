"""Fixtures and settings of all tests: one thread per process, no display, no GPU tests on a CPU."""

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
    """The CPU and, marked `cuda`, the GPU."""
    return request.param


@pytest.fixture(scope="session")
def launch_on_cpu(tmp_path_factory):
    """A launcher of the networks' CUDA kernels, compiled for the CPU with `cuda_on_cpu.h`. It takes
    the place of `launch`.
    """
    from megastep.agents.networks.kernels.program import CORES, DTYPES, STRUCTS
    from megastep.kernels.build import compile

    folder = tmp_path_factory.mktemp("kernels")
    source, library = folder / "kernels.cpp", folder / "kernels.so"
    header = Path(__file__).parent / "helpers" / "cuda_on_cpu.h"
    lines = [f'#include "{path}"' for path in [header, *sorted(CORES.folder.glob("*.cu"))]]
    lines += [
        f'extern "C" void run_{name}_{dtype}(const {struct}* p, unsigned int threads) '
        f"{{ launch({name}_{dtype}, p, threads); }}"
        for name, struct in STRUCTS.items()
        for dtype in DTYPES.values()
    ]
    source.write_text("\n".join(lines))
    compiler, _ = compile._compiler()
    command = [compiler, "-std=c++17", "-O1", "-shared", "-fPIC", f"-DBLOCK={compile.BLOCK}"]
    subprocess.run([*command, str(source), "-o", str(library)], check=True)
    compiled = ctypes.CDLL(str(library))

    def launch(operation, packed, device, threads, program):
        assert program is CORES and device.type == "cpu"
        getattr(compiled, f"run_{operation}")(packed, ctypes.c_uint(threads))

    return launch
