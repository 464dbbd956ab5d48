// The sum over a block.
#pragma once
#include "common/constants.h"
#include "number.h"

// In a fixed order, in every thread of a block of THREADS: 32, 64, 128, ... 1024.
template <int THREADS, class T>
DEVICE T sum_of_block(T x) {
    constexpr int WARPS = THREADS / WARP;
    __shared__ T of_warps[WARPS];
    for (int mask = WARP / 2; mask; mask /= 2)
        x += __shfl_xor_sync(~0u, x, mask);
    __syncthreads();  // the last sum was read
    if (threadIdx.x % WARP == 0)
        of_warps[threadIdx.x / WARP] = x;
    __syncthreads();
    x = of_warps[threadIdx.x % WARPS];
    for (int mask = WARPS / 2; mask; mask /= 2)
        x += __shfl_xor_sync(~0u, x, mask);
    return x;
}
