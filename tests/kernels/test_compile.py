"""Building and launching the kernels: params by name, files and lines by name, and what is missing
or fails. Each fault is injected for real.
"""

import contextlib
import ctypes
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from megastep import engine
from megastep.agents.networks.kernels.program import CORES
from megastep.engine import agents
from megastep.envs.deathmatch.step import MAX_AGENTS
from megastep.envs.pointgoal.step import PROGRESS_ROWS, TOLD
from megastep.envs.pong.step import CELL, FEATURES, GAME_FIELDS, PIXELS
from megastep.kernels.build import compile, launch

ROOT = Path(__file__).resolve().parents[2]
STEP = """
import torch
from megastep import engine, scene, toys
scenery = scene.scenery([toys.box()], device='cpu')
print(round(float(scenery.baked.vals.sum()), 3))
"""


def run(code, cache, **env):
    """Runs code in a new interpreter with a kernel cache of its own; returns (exit status, stdout,
    stderr).
    """
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "MEGASTEP_CACHE": str(cache), **env},
    )
    return done.returncode, done.stdout.strip(), done.stderr


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A cache after a first use, and what that printed."""
    cache = tmp_path_factory.mktemp("cache")
    status, out, err = run(STEP, cache)
    assert status == 0, err
    return cache, out


@pytest.mark.parametrize("package", ["megastep", "agents/networks"])
def test_packed_params_have_the_compilers_layout(tmp_path, package):
    """A compiler reads every field of every packed struct as it was given."""
    folder = ROOT / package / "kernels"
    structs = launch.fields_of(folder)
    params, sizes = launch.builders(structs), launch.sizes_of(structs)
    reads, given = [], {}
    for name, fields in structs.items():
        values = {field: position + 1 for position, (field, _) in enumerate(fields)}
        values |= {field: bytes(int(kind[2:-1])) for field, kind in fields if kind[-1] == "s"}
        given[name] = getattr(params, name)(**values)
        tests = [
            f"(long long)p->{field} == {values[field]}" for field, kind in fields if kind[-1] != "s"
        ]
        reads.append(
            f'extern "C" int check_{name}(const {name}* p, int size) '
            f"{{ return size == sizeof({name}) && {' && '.join(tests)}; }}\n"
        )
    source = tmp_path / "checks.cpp"
    source.write_text((folder / "params.h").read_text() + "".join(reads))
    compiler, _ = compile._compiler()
    library = tmp_path / "checks.so"
    command = [compiler, "-std=c++17", "-shared", "-fPIC", str(source), "-o", str(library)]
    subprocess.run(command, check=True)
    checks = ctypes.CDLL(str(library))
    for name, packed in given.items():
        assert getattr(checks, f"check_{name}")(packed, sizes[name]), name
        assert len(packed) == sizes[name]


def test_a_field_that_is_misspelt_or_missing_is_named():
    fields = dict(counts=0, mask=0, out=0, key0=1, key1=2, n_lanes=0, n_threads=1)
    launch.params.UniformParams(**fields)
    with pytest.raises(TypeError, match=r"UniformParams\(\) got an unexpected .* 'n_lane'"):
        launch.params.UniformParams(**fields, n_lane=3)
    del fields["key1"]
    with pytest.raises(TypeError, match=r"UniformParams\(\) missing 1 required .* 'key1'"):
        launch.params.UniformParams(**fields)
    with pytest.raises(TypeError):
        launch.params.UniformParams(0, 0, 0, 1, 2, 0, 1)


def test_every_operation_keeps_its_file_and_line_in_the_program(tmp_path):
    """The preprocessor, whose line markers messages and ncu follow, finds each kernel in the file
    of its name, at the line where it stands.
    """
    files = compile.sources(".h", ".cu")
    program = tmp_path / "engine.cu"
    program.write_text(compile.program_of(files))
    compiler, _ = compile._compiler()
    done = subprocess.run(
        [compiler, "-E", "-x", "c++", "-D__CUDACC__", f"-I{compile.HERE}", str(program)],
        capture_output=True,
        text=True,
        check=True,
    )
    found, name, line = {}, None, 0
    for text in done.stdout.splitlines():
        marker = re.match(r'# (\d+) "(.*?)"', text)
        if marker:
            line, name = int(marker[1]), Path(marker[2]).name
            continue
        kernel = re.match(r'extern "C" __global__ void .*?(\w+)\(\w+Params p\)', text)
        if kernel:
            found[kernel[1]] = name, line
        line += 1
    assert sorted(found) == sorted(compile.OPERATIONS)
    for operation, (name, line) in found.items():
        assert name == f"{operation}.cu"
        assert files[name].splitlines()[line - 1].startswith("KERNEL")


def nvrtc(files, flags=compile.CUDA_FLAGS):
    """A cubin of these files, by NVRTC, which needs no GPU."""
    try:
        return compile._build_cuda(files, (*flags, "--gpu-architecture=sm_90"))
    except (compile.EngineError, RuntimeError) as error:
        if "NVRTC could not build" in str(error):
            raise
        pytest.skip(f"needs NVRTC: {error}")


def test_nvrtc_builds_the_learners_kernels():
    """With its own flags, and as another program than the engine's."""
    cubin = nvrtc(compile.sources(".h", ".cu", folder=CORES.folder), CORES.flags)
    assert all(operation.encode() in cubin for operation in CORES.operations)


def test_nvrtc_is_told_files_and_lines():
    files = compile.sources(".h", ".cu")
    cubin = nvrtc(files)
    assert all(f"{operation}.cu".encode() in cubin for operation in compile.OPERATIONS)
    broken = {**files, "spawn.cu": files["spawn.cu"] + "\nint broken"}
    line = len(broken["spawn.cu"].splitlines())
    with pytest.raises(compile.EngineError, match=rf"spawn\.cu\({line}\): error"):
        nvrtc(broken)


def test_nothing_is_built_at_import(tmp_path):
    status, _, err = run(
        "import megastep.envs, megastep.cuda, megastep.modules, megastep.recording",
        tmp_path / "cache",
    )
    assert status == 0 and not (tmp_path / "cache").exists(), err


def test_no_compiler_is_one_sentence_with_the_cure(tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "/nonexistent")
    with pytest.raises(
        compile.EngineError, match="CXX=/nonexistent is not a program: install one .*or set CXX"
    ) as error:
        compile._compiler()
    assert "\n" not in str(error.value)
    monkeypatch.delenv("CXX")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(compile.EngineError, match="needs a C\\+\\+ compiler and none"):
        compile._compiler()


def test_a_compiler_that_fails_is_quoted(tmp_path, monkeypatch):
    false = tmp_path / "c++"
    false.write_text(
        '#!/bin/sh\n[ "$1" = --version ] && echo broken 1.0 && exit 0\n'
        'echo "no room on device" >&2; exit 1\n'
    )
    false.chmod(0o755)
    with pytest.raises(
        compile.EngineError, match="could not build the CPU engine.*no room on device"
    ):
        compile._build_cpu(str(false))


@pytest.mark.skipif(shutil.which("objdump") is None, reason="needs objdump")
def test_nothing_is_fused(tmp_path):
    """A multiplication fused with an addition rounds once, not twice, and the GPU's kernels have
    none.
    """
    library = tmp_path / "engine.so"
    library.write_bytes(compile._build_cpu(compile._compiler()[0]))
    code = subprocess.run(
        ["objdump", "-d", str(library)], capture_output=True, text=True, check=True
    ).stdout
    fused = re.findall(r"\t(v?fn?m(?:add|sub|la|ls)\w*)", code)
    assert "ret" in code and not fused, f"{len(fused)} fused, among them {fused[:3]}"


def test_no_bindings_are_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "cuda.bindings", None)
    compile.bindings.cache_clear()
    with pytest.raises(compile.EngineError, match="pip install cuda-bindings"):
        compile.bindings()


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_the_gpu_sees_damage_too(tmp_path):
    code = STEP.replace("'cpu'", "'cuda'")
    status, out, err = run(code, tmp_path)
    assert status == 0, err
    (path,) = tmp_path.iterdir()
    path.write_bytes(path.read_bytes()[:5000])
    assert run(code, tmp_path)[:2] == (0, out)


RECIPROCALS = """
#include "backend.h"
KERNEL reciprocals(float* values, int n) {
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < n) values[i] = RECIPROCAL(values[i]);
}
"""


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("exponent", [-100, -20, -1, 0, 1, 7, 100])
def test_the_gpus_reciprocal_rounds_as_division_does(exponent):
    """Every significand, of either sign."""
    major, minor = torch.cuda.get_device_capability()
    files = {**compile.sources(".h"), "reciprocals.cu": RECIPROCALS}
    driver, _ = compile.bindings()
    cubin = compile._build_cuda(
        files, (*compile.CUDA_FLAGS, f"--gpu-architecture=sm_{major}{minor}")
    )
    torch.cuda.current_stream().synchronize()
    module = compile.checked(driver.cuModuleLoadData(cubin), "Loading")
    kernel = compile.checked(driver.cuModuleGetFunction(module, b"reciprocals"), "Loading")
    significands = torch.arange(1 << 23, dtype=torch.int32) | 127 + exponent << 23
    values = torch.cat([significands, significands | -1 << 31]).view(torch.float32)
    found, n = values.cuda(), len(values)
    pointer, count = ctypes.c_void_p(found.data_ptr()), ctypes.c_int(n)
    arguments = (ctypes.c_void_p * 2)(ctypes.addressof(pointer), ctypes.addressof(count))
    stream = torch.cuda.current_stream().cuda_stream
    done = driver.cuLaunchKernel(
        kernel, -(-n // 64), 1, 1, 64, 1, 1, 0, stream, ctypes.addressof(arguments), 0
    )
    compile.checked(done, "Launching")
    assert torch.equal(found.cpu(), 1 / values)


def test_a_thread_without_a_context_takes_the_gpus_and_launches_again(monkeypatch):
    calls, current = [], []

    def launched(function, *shape):
        calls.append((function, *shape))
        return (0 if current else launch.INVALID_CONTEXT,)

    driver = SimpleNamespace(
        cuLaunchKernel=launched,
        cuDeviceGet=lambda index: (0, f"device {index}"),
        cuDevicePrimaryCtxRetain=lambda device: (0, f"context of {device}"),
        cuCtxSetCurrent=lambda context: current.append(context) or (0,),
    )
    monkeypatch.setattr(launch, "bindings", lambda: (driver, None))
    monkeypatch.setattr(launch, "cuda", lambda index, program: {"uniform": "function"})
    monkeypatch.setattr(torch.cuda, "device", lambda index: contextlib.nullcontext())
    monkeypatch.setattr(torch.cuda, "current_stream", lambda index: SimpleNamespace(cuda_stream=7))
    for _ in range(2):
        launch.launch("uniform", b"params", torch.device("cuda", 1), threads=100)
    assert current == ["context of device 1"] and len(calls) == 3
    assert calls[0] == calls[1] and calls[0][:4] == ("function", 2, 1, 1)


def test_sizes_that_python_and_the_kernels_have_are_the_same():
    names = "unseen.h", "pong.h", "shoot.h", "seek.h", "errors.h"
    text = "".join((compile.HERE / name).read_text() for name in names)
    found = {name: int(value) for name, value in re.findall(r"\b([A-Z_]+) = (\d+)\b", text)}
    assert (found["BANDS"], found["SECTORS"]) == (engine.BANDS, engine.SECTORS)
    assert found["GAME_FIELDS"] == GAME_FIELDS and found["N_FEATURES"] == FEATURES
    assert found["CELL"] == CELL and found["MAX_AGENTS"] == MAX_AGENTS
    assert (found["HEIGHT"], found["WIDTH"]) == PIXELS  # in cells
    assert found["COLLISIONS"] + 1 == PROGRESS_ROWS and found["TOLD"] == TOLD
    assert found["KINDS"] == agents._KINDS
