// Means and variances, in parts that masked_moments adds up, and adding them to running statistics:
// of observations over lanes; and of the valid ones of many numbers, such as returns.
#include "common/sums.h"
#include "params.h"

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

DEVICE void write_part(float* parts, float count, float mean, float squares) {
    float* part = parts + 3ll * ((long long)blockIdx.y * gridDim.x + blockIdx.x);
    if (threadIdx.x)
        return;
    part[0] = count;
    part[1] = mean;
    part[2] = squares;
}

// Blocks along x: parts of the lanes; along y: statistics.
KERNEL __launch_bounds__(256) moments(MomentsParams p) {
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
    write_part(p.parts, n_counted, mean, __fdiv_rn(squares, group));
}

// Of old numbers and, in this fraction, of new ones, whose mean is so far away.
DEVICE float variance_of(float old, float added, float away, float rate) {
    return old + rate * (added - old) + rate * (1.f - rate) * away * away;
}

// Changes nothing if no lane was counted, if moments do not count, or if a number is not finite.
KERNEL __launch_bounds__(1024) add_moments(AddMomentsParams p) {
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
            float variance = variance_of(old_variance, norm.new_variance[i], away, rate);
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

// ---- The valid ones of many numbers; blocks along y: arrays ----

// A block has MASKED_NUMBERS neighbouring numbers of an array per thread.
KERNEL __launch_bounds__(256) masked_parts(MaskedPartsParams p) {
    wait_for_previous();
    const float* values = p.arrays[blockIdx.y].values;
    int first = blockIdx.x * (MASKED_THREADS * MASKED_NUMBERS) + threadIdx.x;
    float numbers[MASKED_NUMBERS], count = 0.f, sum = 0.f, squares = 0.f;
    bool counts[MASKED_NUMBERS];
    for (int i = 0; i < MASKED_NUMBERS; i++) {
        int at = first + i * MASKED_THREADS;
        counts[i] = at < p.n && p.valid[at];
        numbers[i] = at < p.n ? values[at] : 0.f;
    }
    for (int i = 0; i < MASKED_NUMBERS; i++) {
        count += counts[i] ? 1.f : 0.f;
        sum += counts[i] ? numbers[i] : 0.f;
    }
    count = sum_of_block<MASKED_THREADS>(count);
    float mean = __fdiv_rn(sum_of_block<MASKED_THREADS>(sum), fmaxf(count, 1.f));
    for (int i = 0; i < MASKED_NUMBERS; i++) {
        float away = numbers[i] - mean;
        squares += counts[i] ? away * away : 0.f;
    }
    squares = sum_of_block<MASKED_THREADS>(squares);
    write_part(p.parts, count, mean, squares);
}

// A block adds up the parts of an array (Chan et al. 1979).
KERNEL __launch_bounds__(256) masked_moments(MaskedMomentsParams p) {
    wait_for_previous();
    const float* parts = p.parts + 3ll * blockIdx.y * p.n_parts;
    double count = 0., sum = 0., squares = 0.;
    for (int i = threadIdx.x; i < p.n_parts; i += MASKED_THREADS) {
        count += parts[3 * i];
        sum += (double)parts[3 * i] * parts[3 * i + 1];
    }
    count = sum_of_block<MASKED_THREADS>(count);
    double n = count < 1. ? 1. : count, mean = sum_of_block<MASKED_THREADS>(sum) / n;
    for (int i = threadIdx.x; i < p.n_parts; i += MASKED_THREADS) {
        double away = parts[3 * i + 1] - mean;
        squares += parts[3 * i + 2] + parts[3 * i] * away * away;
    }
    squares = sum_of_block<MASKED_THREADS>(squares);
    if (threadIdx.x)
        return;
    p.moments[blockIdx.y] = (float)mean;
    p.moments[gridDim.y + blockIdx.y] = (float)(squares / n);
    if (!blockIdx.y)
        *p.n_valid = (long long)count;
}

// Changes nothing if no return is valid, if a number is not finite, or if all returns have been 0.
KERNEL __launch_bounds__(256) add_returns(AddReturnsParams p) {
    wait_for_previous();
    float old_mean = *p.mean, old_scale = *p.scale, count = *p.count + 1.f;
    float rate = fminf(fmaxf(__fdiv_rn(1.f, count), p.min_rate), 1.f);
    float away = *p.new_mean - old_mean, old_variance = old_scale * old_scale;
    float variance = variance_of(old_variance, *p.new_variance, away, rate);
    float mean = old_mean + rate * away, scale = sqrtf(variance);
    bool is_nothing = count == 1.f && scale == 0.f && mean == 0.f;
    float min_scale = fmaxf(p.min_scale, RESOLUTION * fabsf(mean));
    scale = scale < min_scale ? min_scale : scale;  // NaN stays
    bool is_counted = !p.is_counted || *p.is_counted;
    if (!is_counted || is_nothing || *p.n_valid <= 0 || !isfinite(mean + scale))
        return;
    for (int i = threadIdx.x; i < p.width; i += MASKED_THREADS)
        p.weight[i] *= __fdiv_rn(old_scale, scale);
    __syncthreads();  // all have read the old statistics
    if (threadIdx.x)
        return;
    *p.bias = __fdiv_rn(*p.bias * old_scale + (old_mean - mean), scale);
    *p.mean = mean;
    *p.scale = scale;
    *p.count = count;
}
