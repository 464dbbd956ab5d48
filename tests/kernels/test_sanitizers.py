"""The CPU's kernels, built with AddressSanitizer and UndefinedBehaviorSanitizer. PyTorch's memory
comes from the same allocator, so reading or writing beside a tensor ends the process.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from megastep.kernels.build import compile

ROOT = Path(__file__).parents[2]
FLAGS = "-O1 -g -fno-omit-frame-pointer -fno-sanitize-recover=all "
FLAGS += "-fsanitize=${SANITIZERS:-address,undefined,float-cast-overflow}"
BAD_INDICES = "tests/engine/test_bad_indices.py"  # whose sums may overflow
OVERRUN = """
import ctypes, sys, torch
values = torch.zeros(4)
ctypes.CDLL(sys.argv[1]).write(ctypes.c_void_p(values.data_ptr()), int(sys.argv[2]))
"""

pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory):
    """Environment variables with which kernels are built and run with the sanitizers."""
    folder = tmp_path_factory.mktemp("sanitized")
    compiler, _ = compile.compiler()
    wrapper = folder / "c++"
    wrapper.write_text(
        f'#!/bin/sh\n[ "$1" = --version ] && exec {compiler} --version\n'
        f'exec {compiler} "$@" {FLAGS}\n'
    )
    wrapper.chmod(0o755)
    found = [
        subprocess.check_output([compiler, f"-print-file-name={name}"], text=True).strip()
        for name in ("libasan.so", "libubsan.so", "libstdc++.so.6")
    ]
    if not all(map(os.path.exists, found)):
        pytest.skip("needs GCC's sanitizers")
    return dict(
        os.environ,
        CXX=str(wrapper),
        MEGASTEP_CACHE=str(folder / "cache"),
        LD_PRELOAD=":".join(found),
        ASAN_OPTIONS="detect_leaks=0",  # Python never frees all
        UBSAN_OPTIONS="print_stacktrace=1",
        PYTHONPATH=str(ROOT),
    )


def finished(environment, *command):
    """Runs Python. Returns (exit code, stdout and stderr)."""
    process = subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=ROOT,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    return process.returncode, process.stdout


@pytest.mark.parametrize("at, code", [(3, 0), (4, 1)])
def test_a_write_beside_a_tensor_is_found(sanitized, tmp_path, at, code):
    source, library = tmp_path / "write.cpp", tmp_path / "write.so"
    source.write_text('extern "C" void write(float* values, int at) { values[at] = 1; }\n')
    command = [sanitized["CXX"], "-shared", "-fPIC", str(source), "-o", str(library)]
    subprocess.run(command, check=True)
    returned, output = finished(sanitized, "-c", OVERRUN, library, at)
    assert returned == code and ("heap-buffer-overflow" in output) == (code == 1), output


def test_every_operation(sanitized):
    code, output = finished(sanitized, ROOT / "scripts" / "sanitize.py", "cpu")
    assert (code, output) == (0, "done\n"), output


@pytest.mark.parametrize("tests", ["tests/engine", "tests/modules", "tests/envs/test_pong.py"])
def test_other_tests_pass(sanitized, tests):
    words = "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", tests
    code, output = finished(sanitized, *words, f"--deselect={BAD_INDICES}")
    assert code == 0, output[-5000:]


def test_bad_indices_reach_no_other_memory(sanitized, tmp_path):
    environment = dict(sanitized, SANITIZERS="address", MEGASTEP_CACHE=str(tmp_path))
    code, output = finished(environment, "-m", "pytest", "-q", "-n0", BAD_INDICES)
    assert code == 0, output[-5000:]
