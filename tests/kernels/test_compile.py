"""Building and launching kernels: line numbers, missing or failing compilers, GPU contexts."""

import contextlib
import ctypes
import os
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import check_kernels
import pytest
import torch

from megastep import cache
from megastep.kernels.build import compile, kernel_library, launch
from megastep.kernels.build.copies import LIBRARY as COPIES
from megastep.kernels.build.launch import ENGINE

GPU = torch.device("cuda", 0)
UNIFORM = dict(counts=None, mask=None, out=None, key0=1, key1=2, n_lanes=0, n_threads=1)
ROOT = Path(__file__).resolve().parents[2]
STEP = """
import torch
from megastep import engine, scene, toys
scenery = scene.scenery([toys.box()], device='cpu')
print(round(float(scenery.baked.vals.sum()), 3))
"""


def run(code, cache, **env):
    """Runs code in a new interpreter with its own cache. Returns (exit status, stdout, stderr)."""
    process = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "MEGASTEP_CACHE": str(cache), **env},
    )
    return process.returncode, process.stdout.strip(), process.stderr


FOUND = check_kernels.libraries()
GAMES = {one.folder.parent.name: one for one in FOUND if one.folder.parents[1].name == "envs"}
libraries = pytest.mark.parametrize("kernels", [ENGINE, *GAMES.values()], ids=["engine", *GAMES])


@libraries
def test_cpu_and_gpu_have_the_same_operations(kernels):
    operations = dict(kernels.cuda_operations)
    # by other numbers of warps and registers
    for variant in "render_split", "render_unspilled", "physics_unspilled":
        operations.pop(variant, None)
        operations.pop(variant.replace("_", "_objects_"), None)
    assert kernels.cpu_operations == operations != {}


@pytest.mark.cuda
@pytest.mark.skipif(
    torch.cuda.is_available() and torch.cuda.get_device_capability() != (9, 0),
    reason="other GPUs have other numbers of registers",
)
def test_unspilled_kernels_keep_all_in_registers():
    driver, _ = compile.bindings()
    local_bytes = driver.CUfunction_attribute.CU_FUNC_ATTRIBUTE_LOCAL_SIZE_BYTES
    functions = compile.cuda(ENGINE, 0)
    spilled = {
        name: compile.check_status(driver.cuFuncGetAttribute(local_bytes, function), "Asking")
        for name, function in functions.items()
    }
    unspilled = "physics_unspilled", "render_split", "render_unspilled"
    assert [spilled[name] for name in unspilled] == [0, 0, 0]
    assert spilled["physics"] > 0 and spilled["render"] > 0, "if not, the others are not needed"


def nvrtc(files, flags=kernel_library.CUDA_FLAGS):
    """A cubin of these files, by NVRTC, which needs no GPU. Skips if there is no NVRTC."""
    try:
        return compile._build_cuda(files, (*flags, "--gpu-architecture=sm_90"))
    except (compile.EngineError, RuntimeError) as error:
        if "NVRTC could not build" in str(error):
            raise
        pytest.skip(f"needs NVRTC: {error}")


def test_nvrtc_reports_file_and_line():
    files = {**ENGINE.sources(".h"), "bad.cu": '#include "spawn.h"\nint broken'}
    with pytest.raises(compile.EngineError, match=r"bad\.cu\(2\): error"):
        nvrtc(files)


def test_no_compiler(tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "/nonexistent")
    with pytest.raises(compile.EngineError, match="CXX=/nonexistent.*or set CXX") as error:
        compile.compiler()
    assert "\n" not in str(error.value)
    monkeypatch.delenv("CXX")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(compile.EngineError, match=r"c\+\+, g\+\+, clang\+\+ are missing.*install"):
        compile.compiler()


def test_a_failing_compiler_is_quoted(tmp_path, monkeypatch):
    false = tmp_path / "c++"
    false.write_text(
        '#!/bin/sh\n[ "$1" = --version ] && echo broken 1.0 && exit 0\n'
        'echo "no room on device" >&2; exit 1\n'
    )
    false.chmod(0o755)
    with pytest.raises(compile.EngineError, match="could not build.*no room on device"):
        compile._build_cpu(ENGINE, str(false))


@pytest.mark.slow
@libraries
@pytest.mark.skipif(shutil.which("objdump") is None, reason="needs objdump")
def test_no_fused_multiply_adds(kernels, tmp_path, monkeypatch):
    """They round once instead of twice, so the CPU's bits would differ from the GPU's."""
    library, fetch = tmp_path / "engine.so", cache.fetch

    def noted(name, build):
        content, path = fetch(name, build)
        library.write_bytes(content)
        return content, path

    monkeypatch.setattr(cache, "fetch", noted)
    compile.cpu.__wrapped__(kernels)
    code = subprocess.run(
        ["objdump", "-d", str(library)], capture_output=True, text=True, check=True
    ).stdout
    fused = re.findall(r"\t(v?fn?m(?:add|sub|la|ls)\w*)", code)
    assert "ret" in code and not fused, f"{len(fused)} fused, among them {fused[:3]}"


def test_missing_cuda_bindings_are_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "cuda.bindings", None)
    compile.bindings.cache_clear()
    with pytest.raises(compile.EngineError, match="pip install cuda-bindings"):
        compile.bindings()


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_damaged_cubin_is_built_again(tmp_path):
    code = STEP.replace("'cpu'", "'cuda'")
    status, out, err = run(code, tmp_path)
    assert status == 0, err
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:5000])
    assert run(code, tmp_path)[:2] == (0, out)


RECIPROCALS = """
#include "common/backend.h"
KERNEL reciprocals(float* values, int n) {
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < n) values[i] = RECIPROCAL(values[i]);
}
"""


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("exponent", [-100, -20, -1, 0, 1, 7, 100])
def test_gpu_reciprocal_rounds_as_division_does(exponent):
    """Every significand, of either sign."""
    major, minor = torch.cuda.get_device_capability()
    files = {**ENGINE.sources(".h"), "reciprocals.cu": RECIPROCALS}
    driver, _ = compile.bindings()
    cubin = compile._build_cuda(
        files, (*kernel_library.CUDA_FLAGS, f"--gpu-architecture=sm_{major}{minor}")
    )
    torch.cuda.current_stream().synchronize()
    module = compile.check_status(driver.cuModuleLoadData(cubin), "Loading")
    kernel = compile.check_status(driver.cuModuleGetFunction(module, b"reciprocals"), "Loading")
    significands = torch.arange(1 << 23, dtype=torch.int32) | 127 + exponent << 23
    values = torch.cat([significands, significands | -1 << 31]).view(torch.float32)
    reciprocals, n = values.cuda(), len(values)
    pointer, count = ctypes.c_void_p(reciprocals.data_ptr()), ctypes.c_int(n)
    arguments = (ctypes.c_void_p * 2)(ctypes.addressof(pointer), ctypes.addressof(count))
    stream = torch.cuda.current_stream().cuda_stream
    status = driver.cuLaunchKernel(
        kernel, -(-n // 64), 1, 1, 64, 1, 1, 0, stream, ctypes.addressof(arguments), 0
    )
    compile.check_status(status, "Launching")
    assert torch.equal(reciprocals.cpu(), 1 / values)


def test_without_early_starts_no_kernel_starts_early(monkeypatch):
    starts = []
    driver = SimpleNamespace(cuLaunchKernelEx=lambda *call: (0,))
    monkeypatch.setattr(launch, "bindings", lambda: (driver, None))
    monkeypatch.setattr(launch, "cuda", lambda library, index: {"copy_all": "function"})
    monkeypatch.setattr(torch.cuda, "device", lambda index: contextlib.nullcontext())
    monkeypatch.setattr(torch.cuda, "current_stream", lambda index: SimpleNamespace(cuda_stream=7))
    monkeypatch.setattr(launch, "_can_start_early", lambda index: True)
    monkeypatch.setattr(launch, "_config", lambda blocks, stream, is_early: starts.append(is_early))

    def copy():
        operation = COPIES, "copy_all", torch.device("cuda", 1), 100
        launch.launch(*operation, copies=b"", condition=None, n_copies=0, row=None, row_bytes=0)

    copy()
    with launch.without_early_starts():
        with launch.without_early_starts():
            copy()
        thread = threading.Thread(target=copy)  # as that of a backward pass
        thread.start()
        thread.join()
    copy()
    assert starts == [True, False, False, True]


@pytest.mark.cuda
@pytest.mark.parametrize(
    "blocks, action",
    [
        (launch.Blocks(1, threads=2048), "Launching uniform"),
        (launch.Blocks(1, 2**16), "Launching uniform"),
        (launch.Blocks(1, shared=2**30), "Reserving shared memory"),
    ],
)
def test_a_launch_that_the_gpu_refuses_is_named(blocks, action):
    """The next one works again."""
    counts = torch.zeros(1, dtype=torch.int32, device="cuda")
    mask = torch.ones(1, dtype=torch.bool, device="cuda")
    out = torch.full((1, 4), -1.0, device="cuda")
    fields = UNIFORM | dict(counts=counts, mask=mask, out=out, n_lanes=1)
    with pytest.raises(compile.EngineError, match=f"{action} failed with CUDA_ERROR_INVALID_VALUE"):
        launch.launch(ENGINE, "uniform", out.device, blocks, **fields)
    launch.launch(ENGINE, "uniform", out.device, 1, **fields)
    assert ((0 <= out) & (out < 1)).all()
