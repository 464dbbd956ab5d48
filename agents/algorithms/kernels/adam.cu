// Adam with decoupled weight decay for many parameters in one launch, and the norm of their
// gradients. A block handles part of one parameter; blocks along y are policies.
#include "common/constants.h"
#include "constants.h"
#include "params.h"

#define KERNEL extern "C" __global__ void

// The row of this block: the last one that begins at or before it.
static __device__ __forceinline__ int row_of_block(const AdamRowParams* rows, int n_rows) {
    int first = 0, end = n_rows;
    while (end - first > 1) {
        int middle = (first + end) / 2;
        (rows[middle].first_block <= blockIdx.x ? first : end) = middle;
    }
    return first;
}

static_assert(sizeof(AdamParams::rows) == ADAM_ROWS * sizeof(AdamRowParams));
static_assert(sizeof(SquaredNormParams::rows) == ADAM_ROWS * sizeof(AdamRowParams));

KERNEL squared_norm(SquaredNormParams p) {
    const AdamRowParams& row = p.rows[row_of_block(p.rows, p.n_rows)];
    unsigned int first = (blockIdx.x - row.first_block) * (BLOCK * ADAM_NUMBERS) + threadIdx.x;
    const float* gradient = row.gradient + blockIdx.y * (long long)row.n;
    float values[ADAM_NUMBERS], sum = 0.f;
#pragma unroll
    for (int i = 0; i < ADAM_NUMBERS; i++)
        values[i] = first + i * BLOCK < row.n ? gradient[first + i * BLOCK] : 0.f;
#pragma unroll
    for (int i = 0; i < ADAM_NUMBERS; i++)
        sum += values[i] * values[i];
    for (int mask = WARP / 2; mask; mask /= 2)
        sum += __shfl_xor_sync(~0u, sum, mask);
    __shared__ float of_warps[BLOCK / WARP];
    if (threadIdx.x % WARP == 0)
        of_warps[threadIdx.x / WARP] = sum;
    __syncthreads();
    if (!threadIdx.x) {
        float total = 0.f;
        for (int warp = 0; warp < BLOCK / WARP; warp++)
            total += of_warps[warp];
        p.sums[blockIdx.y * gridDim.x + blockIdx.x] = total;
    }
}

KERNEL adam(AdamParams p) {
    unsigned int policy = blockIdx.y;
    if (!p.is_taken[policy])
        return;
    const AdamRowParams& row = p.rows[row_of_block(p.rows, p.n_rows)];
    unsigned int first = (blockIdx.x - row.first_block) * (BLOCK * ADAM_NUMBERS) + threadIdx.x;
    float clip = p.grad_norm ? fminf(p.max_norm / (p.grad_norm[policy] + 1e-6f), 1.f) : 1.f;
    float lr = p.lr[policy] * row.lr_factor, n_steps = p.n_steps[policy];
    float step = lr / (1.f - powf(p.beta1, n_steps));
    float scale = 1.f / sqrtf(1.f - powf(p.beta2, n_steps));
#pragma unroll
    for (int i = 0; i < ADAM_NUMBERS; i++) {
        if (first + i * BLOCK >= row.n)
            break;
        long long at = policy * (long long)row.n + first + i * BLOCK;
        float gradient = row.gradient[at] * clip, mean = row.mean[at];
        mean += (1.f - p.beta1) * (gradient - mean);
        float square = p.beta2 * row.square[at] + (1.f - p.beta2) * gradient * gradient;
        float parameter = row.parameter[at] * (1.f - lr * row.weight_decay);
        row.mean[at] = mean;
        row.square[at] = square;
        row.parameter[at] = parameter - step * mean / (sqrtf(square) * scale + p.eps);
    }
}
