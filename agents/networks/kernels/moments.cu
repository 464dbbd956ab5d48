// Means and variances of observations over lanes, one block per statistic; and adding them to
// running statistics, one block per leaf.
#include "constants.h"
#include "half.h"
#include "lanes.h"
#include "params.h"

DEVICE float number_at(const IntakeLeafParams& leaf, long long at) {
    if (!leaf.is_half)
        return ((const float*)leaf.values)[at];
    return half_value(((const unsigned short*)leaf.values)[at]);
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

DEVICE void add(float& sum, float x, float mean, bool is_square) {
    sum += is_square ? (x - mean) * (x - mean) : x;
}

// The sum of the numbers of a statistic, or of the squares of their distance from `mean`. A lane
// that does not count may hold anything.
template <bool is_square>
DEVICE float sum_of(const MomentsParams& p, const IntakeLeafParams& leaf, int first, float mean) {
    float sum = 0.f;
    bool in_words =
        leaf.is_half && leaf.group % 8 == 0 && (unsigned long long)leaf.values % 16 == 0;
    for (int lane = threadIdx.x; lane < p.n_lanes; lane += MOMENTS_THREADS) {
        if (!p.is_counted[lane])
            continue;
        long long at = (long long)lane * leaf.n_features + first;
        if (in_words) {
            const uint4* words = (const uint4*)((const unsigned short*)leaf.values + at);
#pragma unroll 4
            for (int i = 0; i < leaf.group / 8; i++) {
                uint4 word = words[i];
                const unsigned int pairs[4] = {word.x, word.y, word.z, word.w};
#pragma unroll
                for (int n = 0; n < 4; n++) {
                    add(sum, half_value(pairs[n] & 0xffff), mean, is_square);
                    add(sum, half_value(pairs[n] >> 16), mean, is_square);
                }
            }
        } else
            for (int i = 0; i < leaf.group; i++)
                add(sum, number_at(leaf, at + i), mean, is_square);
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

// Adds moments of returns to a value's statistics, and changes its layer so that no prediction
// changes (PopArt). One block per policy. Changes nothing if there were no returns, or if a number
// is not finite.
KERNEL BOUNDS(1024) add_returns(AddReturnsParams p) {
    int policy = blockIdx.x;
    float count = p.count[policy] + 1.f;
    float rate = fminf(fmaxf(__fdiv_rn(1.f, count), p.min_rate), 1.f);
    float old_mean = p.mean[policy], old_scale = p.scale[policy], bias = p.bias[policy];
    float away = p.new_mean[policy] - old_mean, old_variance = old_scale * old_scale;
    float variance = old_variance + rate * (p.new_variance[policy] - old_variance) +
                     rate * (1.f - rate) * away * away;
    float mean = old_mean + rate * away, scale = sqrtf(variance);
    scale = scale < p.min_scale ? p.min_scale : scale;  // NaN stays
    __syncthreads();                                    // all have read
    if (p.n_returns[policy] <= 0 || !isfinite(mean + scale))
        return;
    float* weight = p.weight + (long long)policy * p.width;
    float ratio = __fdiv_rn(old_scale, scale);
    for (int i = threadIdx.x; i < p.width; i += MOMENTS_THREADS)
        weight[i] *= ratio;
    if (threadIdx.x)
        return;
    p.bias[policy] = __fdiv_rn(bias * old_scale + (old_mean - mean), scale);
    p.mean[policy] = mean;
    p.scale[policy] = scale;
    p.count[policy] = count;
}
