// Means and variances of observations over lanes, in parts that masked_moments adds up; and adding
// them to running statistics, one block per leaf.
#include "block_sum.h"
#include "constants.h"
#include "half.h"
#include "lanes.h"
#include "params.h"

DEVICE float number_at(const IntakeLeafParams& leaf, long long at) {
    if (!leaf.is_half)
        return ((const float*)leaf.values)[at];
    return half_value(((const unsigned short*)leaf.values)[at]);
}

DEVICE void add(float& sum, float x, float mean, bool is_square) {
    sum += is_square ? (x - mean) * (x - mean) : x;
}

// The sum of a part's numbers of a statistic, or of the squares of their distance from `mean`. A
// lane that does not count may hold anything.
template <bool is_square>
DEVICE float sum_of(const MomentsParams& p, const IntakeLeafParams& leaf, int first, float mean) {
    float sum = 0.f;
    bool in_words =
        leaf.is_half && leaf.group % 8 == 0 && (unsigned long long)leaf.values % 16 == 0;
    int start = blockIdx.x * MOMENTS_LANES, end = min(start + MOMENTS_LANES, p.n_lanes);
    for (int lane = start + threadIdx.x; lane < end; lane += MASKED_THREADS) {
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
    return sum_of_block<MASKED_THREADS>(sum);
}

// Blocks along x: parts of the lanes; along y: statistics.
KERNEL BOUNDS(256) moments(MomentsParams p) {
    wait_for_previous();
    int statistic = blockIdx.y, leaf = 0;
    for (; statistic >= p.leaves[leaf].n_features / p.leaves[leaf].group; leaf++)
        statistic -= p.leaves[leaf].n_features / p.leaves[leaf].group;
    IntakeLeafParams chosen = p.leaves[leaf];
    float n_counted = 0.f, group = (float)chosen.group;
    int start = blockIdx.x * MOMENTS_LANES, end = min(start + MOMENTS_LANES, p.n_lanes);
    for (int lane = start + threadIdx.x; lane < end; lane += MASKED_THREADS)
        n_counted += p.is_counted[lane] ? 1.f : 0.f;
    n_counted = sum_of_block<MASKED_THREADS>(n_counted);
    int first = statistic * chosen.group;
    float n = fmaxf(n_counted, 1.f) * group;
    float mean = __fdiv_rn(sum_of<false>(p, chosen, first, 0.f), n);
    float squares = sum_of<true>(p, chosen, first, mean);
    if (threadIdx.x)
        return;
    float* part = p.parts + 3ll * ((long long)blockIdx.y * gridDim.x + blockIdx.x);
    part[0] = n_counted;
    part[1] = mean;
    part[2] = __fdiv_rn(squares, group);
}

// Changes nothing if no lane was counted, if moments do not count, or if a number is not finite.
KERNEL BOUNDS(1024) add_moments(AddMomentsParams p) {
    wait_for_previous();
    const RunningNormParams& norm = p.norms[blockIdx.x];
    bool is_counted = !p.is_counted || *p.is_counted;
    float count = *norm.count + 1.f, rate = __fdiv_rn(1.f, count);
    for (int pass = 0; pass < 2; pass++) {  // first only looks
        bool stores = pass == 1;
        bool is_finite = true;
        for (int i = threadIdx.x; i < norm.n; i += MOMENTS_THREADS) {
            float old_mean = norm.mean[i], old_scale = norm.scale[i];
            float away = norm.new_mean[i] - old_mean;
            float old_variance = old_scale < UNKNOWN_SCALE ? old_scale * old_scale : 0.f;
            float variance = old_variance + rate * (norm.new_variance[i] - old_variance) +
                             rate * (1.f - rate) * away * away;
            float mean = old_mean + rate * away;
            float scale = sqrtf(variance);
            scale = scale <= RESOLUTION * fabsf(mean) ? UNKNOWN_SCALE : scale;  // NaN stays
            is_finite = is_finite && isfinite(mean + scale);
            if (stores) {
                norm.mean[i] = mean;
                norm.scale[i] = scale;
            }
        }
        if (!__syncthreads_and(is_finite) || !is_counted || *norm.n_counted <= 0)
            return;
    }
    if (!threadIdx.x)
        *norm.count = count;
}
