"""What all tests share: one thread a process, no screen, and no GPU tests where there is no GPU."""

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
    """Either device, for tests that hold on both."""
    return request.param


@pytest.fixture(scope="session")
def launch_on_cpu(tmp_path_factory):
    """What launches the learner's kernels on a CPU: their source, compiled for it through
    `cuda_on_cpu.h`.
    """
    from megastep.agents.networks.kernels.program import CORES, DTYPES, STRUCTS
    from megastep.kernels.build import compile

    folder = tmp_path_factory.mktemp("kernels")
    source, library = folder / "kernels.cpp", folder / "kernels.so"
    included = [
        Path(__file__).parent / "helpers" / "cuda_on_cpu.h",
        *sorted(CORES.folder.glob("*.cu")),
    ]
    lines = [f'#include "{path}"' for path in included]
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
    loaded = ctypes.CDLL(str(library))

    def launch(operation, packed, device, threads, program):
        assert program is CORES and device.type == "cpu"
        getattr(loaded, f"run_{operation}")(packed, ctypes.c_uint(threads))

    return launch
