// The number, means and variances of valid entries. First each block takes those of its entries,
// which stay in registers; then one block per quantity joins them in a fixed order (Chan et al.
// 1979). Blocks along y are quantities.
#include "common/constants.h"
#include "constants.h"
#include "params.h"

#define KERNEL extern "C" __global__ void

// The sum over a block, in every thread.
template <class T>
static __device__ __forceinline__ T sum_over_block(T x) {
    __shared__ T of_warps[MOMENTS_THREADS / WARP];
    for (int mask = WARP / 2; mask; mask /= 2)
        x += __shfl_xor_sync(~0u, x, mask);
    __syncthreads();  // an earlier call may still be reading
    if (threadIdx.x % WARP == 0)
        of_warps[threadIdx.x / WARP] = x;
    __syncthreads();
    T sum = 0;
    for (int warp = 0; warp < MOMENTS_THREADS / WARP; warp++)
        sum += of_warps[warp];
    return sum;
}

KERNEL block_moments(BlockMomentsParams p) {
    const float* values = p.quantities[blockIdx.y].values;
    float x[MOMENTS_NUMBERS], n = 0.f, sum = 0.f;
    bool valid[MOMENTS_NUMBERS];
    long long first = (long long)blockIdx.x * (MOMENTS_THREADS * MOMENTS_NUMBERS) + threadIdx.x;
#pragma unroll
    for (int i = 0; i < MOMENTS_NUMBERS; i++) {
        long long at = first + i * MOMENTS_THREADS;
        bool exists = at < p.n_entries;
        valid[i] = exists && p.valid[exists ? at : 0];
        x[i] = values[exists ? at : 0];
    }
#pragma unroll
    for (int i = 0; i < MOMENTS_NUMBERS; i++) {
        n += valid[i] ? 1.f : 0.f;
        sum += valid[i] ? x[i] : 0.f;
    }
    n = sum_over_block(n);
    float mean = sum_over_block(sum) / fmaxf(n, 1.f), squares = 0.f;
#pragma unroll
    for (int i = 0; i < MOMENTS_NUMBERS; i++)
        squares += valid[i] ? (x[i] - mean) * (x[i] - mean) : 0.f;
    squares = sum_over_block(squares);
    float* target = p.parts + 3 * ((long long)blockIdx.y * gridDim.x + blockIdx.x);
    if (!threadIdx.x) {
        target[0] = n;
        target[1] = mean;
        target[2] = squares;
    }
}

KERNEL join_moments(JoinMomentsParams p) {
    const float* parts = p.parts + 3 * (long long)blockIdx.y * p.n_blocks;
    double n = 0, sum = 0, squares = 0;
    for (int i = threadIdx.x; i < p.n_blocks; i += MOMENTS_THREADS) {
        n += parts[3 * i];
        sum += (double)parts[3 * i] * parts[3 * i + 1];
    }
    n = sum_over_block(n);
    double divisor = n < 1 ? 1 : n, mean = sum_over_block(sum) / divisor;
    for (int i = threadIdx.x; i < p.n_blocks; i += MOMENTS_THREADS) {
        double away = parts[3 * i + 1] - mean;
        // a block without entries has the mean 0, which does not count
        squares += parts[3 * i + 2] + parts[3 * i] * away * away;
    }
    squares = sum_over_block(squares);
    if (threadIdx.x)
        return;
    p.means[blockIdx.y] = (float)mean;
    p.variances[blockIdx.y] = (float)(squares / divisor);
    if (!blockIdx.y)
        *p.n_valid = (long long)n;
}
