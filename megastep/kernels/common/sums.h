// Sums over threads, always in the same order.
#pragma once
#include "common/constants.h"
#include "common/dependent_launch.h"

// Over N neighbouring threads of a warp, a power of two, in each of them.
template <int N = WARP, class T>
DEVICE T sum_of_threads(T x) {
    for (int mask = N / 2; mask; mask /= 2)
        x += __shfl_xor_sync(~0u, x, mask);
    return x;
}

// Over a block of THREADS, 32, 64, 128, ... 1024, in each of them.
template <int THREADS, class T>
DEVICE T sum_of_block(T x) {
    constexpr int WARPS = THREADS / WARP;
    __shared__ T of_warps[WARPS];
    x = sum_of_threads(x);
    __syncthreads();  // the last sum was read
    if (threadIdx.x % WARP == 0)
        of_warps[threadIdx.x / WARP] = x;
    __syncthreads();
    return sum_of_threads<WARPS>(of_warps[threadIdx.x % WARPS]);
}

// Of N numbers of each of a block's THREADS. Writes the sums. All threads take part.
template <int THREADS, int N>
DEVICE void add_up(float (&sums)[N], float* target) {
    __shared__ float of_warps[THREADS / WARP][N];
    for (int i = 0; i < N; i++) {
        sums[i] = sum_of_threads(sums[i]);
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

// The largest number of a block of THREADS, in each of them.
template <int THREADS>
DEVICE double largest_of_block(double x) {
    __shared__ double of_warps[THREADS / WARP];
    for (int mask = WARP / 2; mask; mask /= 2)
        x = fmax(x, __shfl_xor_sync(~0u, x, mask));
    if (threadIdx.x % WARP == 0)
        of_warps[threadIdx.x / WARP] = x;
    __syncthreads();
    for (int warp = 0; warp < THREADS / WARP; warp++)
        x = fmax(x, of_warps[warp]);
    return x;
}
