// Sums over a block, always in the same order.
#pragma once
#include "common/constants.h"
#include "common/dependent_launch.h"

// Adds up N numbers of each of a block's THREADS, and writes the sums. All threads take part.
template <int THREADS, int N>
DEVICE void add_up(float (&sums)[N], float* target) {
    __shared__ float of_warps[THREADS / WARP][N];
    for (int i = 0; i < N; i++) {
        for (int mask = WARP / 2; mask; mask /= 2)
            sums[i] += __shfl_xor_sync(~0u, sums[i], mask);
        if (threadIdx.x % WARP == 0)
            of_warps[threadIdx.x / WARP][i] = sums[i];
    }
    __syncthreads();
    if (threadIdx.x >= N)
        return;
    float total = 0.f;
    for (int warp = 0; warp < THREADS / WARP; warp++)
        total += of_warps[warp][threadIdx.x];
    target[threadIdx.x] = total;
}
