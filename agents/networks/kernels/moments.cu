// Means and variances of observations over lanes, one block per statistic; and adding them to running
// statistics, one block per leaf.
#include "constants.h"
#include "lanes.h"
#include "params.h"

DEVICE float number_at(const IntakeLeafParams& leaf, long long at) {
    if (!leaf.is_half)
        return ((const float*)leaf.values)[at];
    float x;
    asm("cvt.f32.f16 %0, %1;" : "=f"(x) : "h"(((const unsigned short*)leaf.values)[at]));
    return x;
}

// The sum over a block in a fixed order, in every thread.
DEVICE float sum_of_block(float x) {
    __shared__ float of_warps[MOMENTS_THREADS / WARP];
    for (int mask = WARP / 2; mask; mask /= 2)
        x += __shfl_xor_sync(~0u, x, mask);
    __syncthreads();
    if (threadIdx.x % WARP == 0)
        of_warps[threadIdx.x / WARP] = x;
    __syncthreads();
    x = of_warps[threadIdx.x % WARP];
    for (int mask = WARP / 2; mask; mask /= 2)
        x += __shfl_xor_sync(~0u, x, mask);
    return x;
}

// The sum of the numbers of a statistic, or of the squares of their distance from `mean`. A lane that
// does not count may hold anything.
template <bool is_square>
DEVICE float sum_of(const MomentsParams& p, const IntakeLeafParams& leaf, int first, float mean) {
    float sum = 0.f;
    int n = p.n_lanes * leaf.group;
#pragma unroll 8
    for (int i = threadIdx.x; i < n; i += MOMENTS_THREADS) {
        int lane = i / leaf.group;
        float x = number_at(leaf, (long long)lane * leaf.n_features + first + i % leaf.group);
        x = is_square ? (x - mean) * (x - mean) : x;
        sum += p.is_counted[lane] ? x : 0.f;
    }
    return sum_of_block(sum);
}

KERNEL BOUNDS(1024) moments(MomentsParams p) {
    int statistic = blockIdx.x, leaf = 0;
    for (; statistic >= p.leaves[leaf].n_features / p.leaves[leaf].group; leaf++)
        statistic -= p.leaves[leaf].n_features / p.leaves[leaf].group;
    IntakeLeafParams chosen = p.leaves[leaf];
    float n_counted = 0.f;
    for (int lane = threadIdx.x; lane < p.n_lanes; lane += MOMENTS_THREADS)
        n_counted += p.is_counted[lane] ? 1.f : 0.f;
    n_counted = sum_of_block(n_counted);  // exact below 2^24
    float n = fmaxf(n_counted, 1.f) * (float)chosen.group;
    int first = statistic * chosen.group;
    float mean = __fdiv_rn(sum_of<false>(p, chosen, first, 0.f), n);
    float variance = __fdiv_rn(sum_of<true>(p, chosen, first, mean), n);
    if (threadIdx.x)
        return;
    p.moments[blockIdx.x] = mean;
    p.moments[p.n_statistics + blockIdx.x] = variance;
    if (!blockIdx.x)
        *p.n_counted = (long long)n_counted;
}

// Changes nothing if no lane was counted, or if a number is not finite.
KERNEL BOUNDS(1024) add_moments(AddMomentsParams p) {
    const RunningNormParams& norm = p.norms[blockIdx.x];
    float count = *norm.count + 1.f, rate = __fdiv_rn(1.f, count);
    for (int pass = 0; pass < 2; pass++) {  // first only looks
        bool stores = pass == 1;
        bool is_finite = true;
        for (int i = threadIdx.x; i < norm.n; i += MOMENTS_THREADS) {
            float old_mean = norm.mean[i], old_scale = norm.scale[i];
            float away = norm.new_mean[i] - old_mean, old_variance = old_scale * old_scale;
            float variance = old_variance + rate * (norm.new_variance[i] - old_variance) +
                             rate * (1.f - rate) * away * away;
            float mean = old_mean + rate * away;
            float scale = sqrtf(variance);
            scale = scale < norm.min_scale ? norm.min_scale : scale;  // NaN stays
            is_finite = is_finite && isfinite(mean + scale);
            if (stores) {
                norm.mean[i] = mean;
                norm.scale[i] = scale;
            }
        }
        if (!__syncthreads_and(is_finite) || *norm.n_counted <= 0)
            return;
    }
    if (!threadIdx.x)
        *norm.count = count;
}
