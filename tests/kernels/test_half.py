"""Rounding to fp16 on the CPU, which the kernels do with integers, against PyTorch."""

import ctypes
import subprocess

import numpy as np
import pytest
import torch

from megastep import core, engine, scene, toys
from megastep.kernels.build import compile, kernel_library

CANONICAL_NAN = 0x7FFF  # a GPU converts every NaN to this one
SOURCE = """
#include "common/backend_cpu.h"
extern "C" void halves(const float* values, unsigned short* out, int n) {
    for (int i = 0; i < n; i++)
        out[i] = HALF_BITS(values[i]);
}
"""
NANS = [0x7F800001, 0x7F801FFF, 0x7F802000, 0x7FA00000, 0x7FC00000, 0x7FFFFFFF]


@pytest.fixture(scope="module")
def halves(tmp_path_factory):
    """The kernels' conversion from floats to the bits of fp16 numbers."""
    folder = tmp_path_factory.mktemp("half")
    (folder / "half.cpp").write_text(SOURCE)
    compiler, _ = compile.compiler()
    flags = [*kernel_library.CPU_FLAGS, f"-I{compile.KERNELS}"]
    subprocess.run(
        [compiler, *flags, str(folder / "half.cpp"), "-o", str(folder / "half.so")], check=True
    )
    function = ctypes.CDLL(str(folder / "half.so")).halves

    def convert(values):
        out = np.empty(len(values), np.uint16)
        function(ctypes.c_void_p(values.ctypes.data), ctypes.c_void_p(out.ctypes.data), len(values))
        return out

    return convert


def test_rounds_as_pytorch_does(halves):
    """Every fp16 number, its float neighbours, and the ties in between."""
    exact = np.arange(0x7C01, dtype=np.uint16).view(np.float16).astype(np.float32)  # 0 to infinity
    exact[-1] = 65536  # the half beyond the largest, whose tie with it rounds to infinity
    ties = (exact[1:] + exact[:-1]) / 2
    bits = np.concatenate([exact, ties, [0, 2e-10, 1e5, 3e38, np.inf]]).astype(np.float32)
    bits = bits.view(np.uint32)
    bits = np.concatenate([bits - 1, bits, bits + 1])
    values = np.concatenate([bits, bits | 0x80000000]).astype(np.uint32).view(np.float32)
    values = values[~np.isnan(values)]
    expected = torch.from_numpy(values).half().view(torch.int16).numpy().view(np.uint16)
    np.testing.assert_array_equal(halves(values), expected)
    assert len(values) > 370_000


def test_nan_stays_nan(halves):
    bits = np.array([nan | sign for nan in NANS for sign in (0, 0x80000000)], np.uint32)
    assert (halves(bits.view(np.float32)) == CANONICAL_NAN).all()


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("nan", NANS)
def test_nan_in_the_imu_has_the_same_bits_on_every_device(nan, device):
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    c = core.Core(scene.scenery([toys.box()], device=device))
    c.agents.angvelocity.view(torch.int32).fill_(nan)
    imu = engine.observe(c.scenery, c.agents, rgb=False, depth=False, imu=True).imu
    assert imu[0, 0].view(torch.int16).tolist() == [CANONICAL_NAN, 0, 0]
