"""What `tests/helpers/cuda_on_cpu.py` does with threads that exchange numbers, and with faults."""

import functools

import numpy as np
import pytest
import torch

from megastep.kernels.build.kernel_library import KernelLibrary
from megastep.kernels.build.launch import Blocks
from tests.helpers.cuda_on_cpu import ORDERS, SCHEDULES, CudaOnCpu

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
#include "common/tensor_cores.h"
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


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A function of a kernel's text: its library, and what stands in for `launch`."""

    @functools.cache
    def build(text, *flags):
        folder = tmp_path_factory.mktemp("exchange")  # a loaded library stays loaded
        (folder / "params.h").write_text(PARAMS)
        (folder / "exchange.cu").write_text(text)
        return KernelLibrary(folder, *flags), CudaOnCpu()

    return build


@pytest.fixture
def exchange(built):
    """A function of a kernel's body and numbers: what its threads, one per number, give back."""

    def run(body, numbers, order="forward", in_every_order=False):
        library, launch = built(KERNEL % body)
        launch.order = order

        def after():
            after = np.full_like(numbers, -1)
            fields = dict(before=numbers.ctypes.data, after=after.ctypes.data, n=len(numbers))
            launch(library, "exchange", CPU, Blocks(-(-len(numbers) // 64), shared=512), **fields)
            return [torch.from_numpy(after)]

        (after,) = launch.in_every_order(after) if in_every_order else after()
        return after.numpy()

    return run


NUMBERS = np.random.default_rng(0).integers(-99, 99, 128).astype(np.int32)
WARPS = NUMBERS.reshape(-1, 32)
BLOCKS = NUMBERS.reshape(-1, 64)
LANES = np.arange(32)
ALL = "0xffffffffu"


@pytest.mark.parametrize("order", ORDERS)
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
def test_threads_exchange_numbers(exchange, body, expected, order):
    np.testing.assert_array_equal(exchange(body, NUMBERS, order), np.ravel(expected))


CLUSTER = """
#include "common/dependent_launch.h"
#include "common/tensor_cores.h"
#include "params.h"

#define BOUNDS(n_blocks) __cluster_dims__(n_blocks, 1, 1)

extern __shared__ __align__(16) unsigned char shared_memory[];

// Each block sends its numbers to the next one of its cluster of two.
KERNEL BOUNDS(2) exchange(NumbersParams p) {
    wait_for_previous();
    Arrivals* arrivals = (Arrivals*)shared_memory;
    float *received = (float*)shared_memory + 4, *sent = received + 4 * 64;
    if (!threadIdx.x) {
        init(arrivals);
        expect(arrivals, 64 * 16);
    }
    cluster_barrier();
    int i = blockIdx.x * 64 + threadIdx.x, other = 1 - cluster_rank();
    sent[4 * threadIdx.x] = p.before[i];
    publish();
    send(address_in(received + 4 * threadIdx.x, other), sent + 4 * threadIdx.x, 16,
         address_in(arrivals, other));
    wait_for(arrivals, 0);
    p.after[i] = (int)received[4 * (63 - threadIdx.x)];
}
"""


@pytest.mark.parametrize("order, is_late", SCHEDULES)
@pytest.mark.parametrize(
    "missing, message",
    [
        ("", None),
        ("wait_for(arrivals, 0);", "something arrives after its end"),
        ("expect(arrivals, 64 * 16);", "its threads wait for each other"),
    ],
)
def test_blocks_of_a_cluster_send_each_other_numbers(built, missing, message, order, is_late):
    library, launch = built(CLUSTER.replace(missing, ""), ("--std=c++17",))
    launch.order, launch.is_late = order, is_late
    before = torch.arange(256, dtype=torch.int32)
    after = torch.full_like(before, -1)

    def run():
        launch(library, "exchange", CPU, Blocks(4, shared=4096), before=before, after=after, n=256)
        return [after.clone()]

    if not message:
        (result,) = run()
        expected = torch.arange(256).view(2, 2, 64).flip(1, 2).flatten()
        assert torch.equal(result.long(), expected)
        return
    with pytest.raises(AssertionError, match=message):
        run()
