"""What `tests/helpers/cuda_on_cpu.py` does with threads that exchange numbers, and with faults."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch

from megastep.kernels.build.program import Program
from tests.helpers.cuda_on_cpu import CudaOnCpu

CPU = torch.device("cpu")
PARAMS = """
#pragma once

struct NumbersParams {
    const int* before;  // (n)
    int* after;         // (n)
    int n;
};
"""
KERNEL = """
#include "common/backend.h"
#include "params.h"

KERNEL exchange(NumbersParams p) {
    wait_for_previous();
    int i = blockIdx.x * blockDim.x + threadIdx.x, lane = i %% WARP;
    if (i >= p.n)
        return;
    int x = p.before[i];
    %s
    p.after[i] = x;
}
"""


@pytest.fixture
def exchange(tmp_path):
    """A function of a kernel's body and numbers: what its threads, one per number, give back."""

    def run(body, numbers, is_reversed=False):
        folder = Path(tempfile.mkdtemp(dir=tmp_path))  # a loaded library stays loaded
        (folder / "params.h").write_text(PARAMS)
        (folder / "exchange.cu").write_text(KERNEL % body)
        program, launch = Program(folder), CudaOnCpu(folder)
        launch.is_reversed = is_reversed
        after = np.full_like(numbers, -1)
        packed = program.params.NumbersParams(
            before=numbers.ctypes.data, after=after.ctypes.data, n=len(numbers)
        )
        launch(program, "exchange", packed, CPU, len(numbers), shared=256)
        return after

    return run


NUMBERS = np.random.default_rng(0).integers(-99, 99, 128).astype(np.int32)
WARPS = NUMBERS.reshape(-1, 32)
BLOCKS = NUMBERS.reshape(-1, 64)
LANES = np.arange(32)
ALL = "0xffffffffu"


@pytest.mark.parametrize("is_reversed", [False, True])
@pytest.mark.parametrize(
    "body, expected",
    [
        (f"x = __shfl_sync({ALL}, x, 3);", WARPS[:, [3] * 32]),
        (f"x = __shfl_xor_sync({ALL}, x, 5);", WARPS[:, LANES ^ 5]),
        (f"x = __shfl_down_sync({ALL}, x, 4);", WARPS[:, np.where(LANES < 28, LANES + 4, LANES)]),
        (f"x = __reduce_add_sync({ALL}, x);", WARPS.sum(1, keepdims=True).repeat(32, 1)),
        (f"x = __reduce_min_sync({ALL}, x);", WARPS.min(1, keepdims=True).repeat(32, 1)),
        (f"x = __reduce_max_sync({ALL}, x);", WARPS.max(1, keepdims=True).repeat(32, 1)),
        (
            f"x = __popc(__ballot_sync({ALL}, x > 0));",
            (WARPS > 0).sum(1, keepdims=True).repeat(32, 1),
        ),
        (f"x = __any_sync({ALL}, x == 98);", (WARPS == 98).any(1, keepdims=True).repeat(32, 1)),
        (f"x = __all_sync({ALL}, x < 99);", np.ones_like(WARPS)),
        # groups of eight, each in its own time
        (
            "unsigned int mask = 255u << lane / 8 * 8; int sum = 0; for (int k = 0; k <= lane / 8; "
            "k++) sum += __reduce_add_sync(mask, x); x = sum;",
            (WARPS.reshape(-1, 4, 8).sum(-1) * [1, 2, 3, 4]).repeat(8, 1),
        ),
        # through shared memory, whose size is dynamic
        (
            "extern __shared__ int shared[]; shared[threadIdx.x] = x; __syncthreads(); "
            "x = shared[63 - threadIdx.x];",
            BLOCKS[:, ::-1],
        ),
        ("x = __syncthreads_or(x == 98);", (BLOCKS == 98).any(1, keepdims=True).repeat(64, 1)),
    ],
)
def test_threads_exchange_numbers(exchange, body, expected, is_reversed):
    np.testing.assert_array_equal(exchange(body, NUMBERS, is_reversed), np.ravel(expected))


@pytest.mark.parametrize(
    "body, message",
    [
        (f"if (lane == 3) return; x = __shfl_sync({ALL}, x, 0);", "meets a thread that has ended"),
        (
            f"if (lane < 16) x = __ballot_sync({ALL}, x); else x = __shfl_sync({ALL}, x, 0);",
            "meets a thread in another operation",
        ),
        ("x = __shfl_sync(0xffffu, x, 0);", "not in its own mask"),
        ("if (lane < 16) x = __shfl_sync(0xffffu, x, 20);", "reads from outside its mask"),
        (
            f"if (lane < 16) {{ __syncthreads(); __syncwarp({ALL}); }} "
            f"else {{ __syncwarp({ALL}); __syncthreads(); }}",
            "its threads wait for each other",
        ),
    ],
)
def test_faults_are_named(exchange, body, message):
    with pytest.raises(AssertionError, match=message):
        exchange(body, NUMBERS)


def test_a_missing_barrier_shows_in_one_of_the_two_orders(exchange):
    body = """
    extern __shared__ int shared[];
    shared[threadIdx.x] = x;
    x = shared[threadIdx.x ^ 1];
    """
    expected = NUMBERS.reshape(-1, 2)[:, ::-1].ravel()
    results = [exchange(body, NUMBERS, is_reversed) for is_reversed in (False, True)]
    assert any((result != expected).any() for result in results)
    with_barrier = body.replace("= x;", "= x; __syncwarp();", 1)
    np.testing.assert_array_equal(exchange(with_barrier, NUMBERS), expected)
