"""A folder of kernels outside of megastep is a kernel library: it runs on CPU and GPU."""

from types import SimpleNamespace

import pytest
import torch

from megastep.kernels.build import launch as launches
from megastep.kernels.build.compile import EngineError
from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import launch

FILES = {
    "constants.h": "#pragma once\nconstexpr int SIDES = 6;\n",
    "params.h": """
#pragma once

struct RollDiceParams {
    const long long* counts;  // (B) rolls so far
    int* out;                 // (B)
    unsigned int key0;
    unsigned int key1;
    int n_lanes;
    float offset;
};
""",
    "roll_dice.h": """
#pragma once
#include "common/philox.h"
#include "constants.h"
#include "params.h"

HD void roll_lane(const RollDiceParams& p, int lane) {
    Philox bits = philox((unsigned int)lane, (unsigned int)p.counts[lane], p.key0, p.key1);
    p.out[lane] = (int)(unit_float(bits.a) * SIDES + p.offset);
}
""",
    "roll_dice.cpp": """
#include "roll_dice.h"

KERNEL roll_dice(const RollDiceParams& p) {
    for (int lane = 0; lane < p.n_lanes; lane++)
        roll_lane(p, lane);
}
""",
    "roll_dice.cu": """
#include "roll_dice.h"

KERNEL roll_dice(RollDiceParams p) {
    int lane = blockIdx.x * blockDim.x + threadIdx.x;
    if (lane < p.n_lanes)
        roll_lane(p, lane);
}
""",
}


def written(folder, *names):
    """A library of these files; by default of all."""
    folder.mkdir(exist_ok=True)
    for name in names or FILES:
        (folder / name).write_text(FILES[name])
    return KernelLibrary(folder)


def roll(library, device, n=1000):
    counts = torch.arange(n, device=device)
    out = torch.zeros(n, dtype=torch.int32, device=device)
    fields = dict(counts=counts, out=out, key0=1, key1=0, n_lanes=n, offset=1.0)
    launch(library, "roll_dice", out.device, n, **fields)
    return out


def test_a_folder_of_kernels_runs(tmp_path, device):
    """With common headers, constants and a struct of its own."""
    library = written(tmp_path / "dice")
    assert library.constants["SIDES"] == 6
    counts = roll(library, device).bincount(minlength=7).tolist()
    assert counts[0] == 0 and len(counts) == 7 and min(counts[1:]) > 120


@pytest.mark.cuda
def test_cpu_and_gpu_agree(tmp_path):
    library = written(tmp_path)
    assert torch.equal(roll(library, "cpu"), roll(library, "cuda").cpu())


def test_a_program_without_a_cpu_kernel_says_so(tmp_path):
    library = written(tmp_path, "constants.h", "params.h", "roll_dice.h", "roll_dice.cu")
    assert library.cuda_operations == dict(roll_dice="RollDiceParams")
    with pytest.raises(EngineError, match=rf"No \.cpp file in {tmp_path} .* roll_dice: add one"):
        roll(library, "cpu")


def test_an_error_in_a_kernel_is_quoted(tmp_path):
    library = written(tmp_path)
    (tmp_path / "roll_dice.cpp").write_text("int broken = nonsense;\n" + FILES["roll_dice.cpp"])
    with pytest.raises(EngineError, match=rf"{tmp_path}.*nonsense"):
        roll(library, "cpu")


def test_shared_memory_that_a_kernel_may_have_never_shrinks(monkeypatch):
    """A launch with less comes between two with more."""
    reserved = []
    attribute = "CU_FUNC_ATTRIBUTE_MAX_DYNAMIC_SHARED_SIZE_BYTES"
    driver = SimpleNamespace(
        CUfunction_attribute=SimpleNamespace(**{attribute: 8}),
        cuFuncSetAttribute=lambda kernel, attribute, n_bytes: reserved.append(n_bytes) or (0,),
    )
    monkeypatch.setattr(launches, "bindings", lambda: (driver, None))
    monkeypatch.setattr(launches, "make_current", lambda index: None)
    monkeypatch.setattr(launches, "_ALLOWED_SHARED", {})
    for n_bytes in (60_000, 50_000, 70_000, 60_000):
        launches._allow_shared("kernel", n_bytes, 0)
    assert reserved == [60_000, 70_000]
