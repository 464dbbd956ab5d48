// Means and variances of the valid ones of many numbers, such as returns; and adding those of
// returns to the critic's (PopArt). Blocks along y: arrays.
#include "block_sum.h"
#include "constants.h"
#include "lanes.h"
#include "params.h"

static_assert(sizeof(MaskedPartsParams::arrays) == MASKED_ARRAYS * sizeof(MaskedArrayParams));

// A block has MASKED_NUMBERS neighbouring numbers of an array per thread.
KERNEL BOUNDS(256) masked_parts(MaskedPartsParams p) {
    wait_for_previous();
    const float* values = p.arrays[blockIdx.y].values;
    int first = blockIdx.x * (MASKED_THREADS * MASKED_NUMBERS) + threadIdx.x;
    float numbers[MASKED_NUMBERS], count = 0.f, sum = 0.f, squares = 0.f;
    bool counts[MASKED_NUMBERS];
#pragma unroll
    for (int i = 0; i < MASKED_NUMBERS; i++) {
        int at = first + i * MASKED_THREADS;
        counts[i] = at < p.n && p.valid[at];
        numbers[i] = at < p.n ? values[at] : 0.f;
    }
#pragma unroll
    for (int i = 0; i < MASKED_NUMBERS; i++) {
        count += counts[i] ? 1.f : 0.f;
        sum += counts[i] ? numbers[i] : 0.f;
    }
    count = sum_of_block<MASKED_THREADS>(count);
    float mean = __fdiv_rn(sum_of_block<MASKED_THREADS>(sum), fmaxf(count, 1.f));
#pragma unroll
    for (int i = 0; i < MASKED_NUMBERS; i++) {
        float away = numbers[i] - mean;
        squares += counts[i] ? away * away : 0.f;
    }
    squares = sum_of_block<MASKED_THREADS>(squares);
    if (threadIdx.x)
        return;
    float* part = p.parts + 3ll * ((long long)blockIdx.y * gridDim.x + blockIdx.x);
    part[0] = count;
    part[1] = mean;
    part[2] = squares;
}

// A block adds up the parts of an array (Chan et al. 1979).
KERNEL BOUNDS(256) masked_moments(MaskedMomentsParams p) {
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
KERNEL BOUNDS(256) add_returns(AddReturnsParams p) {
    wait_for_previous();
    float old_mean = *p.mean, old_scale = *p.scale, count = *p.count + 1.f;
    float rate = fminf(fmaxf(__fdiv_rn(1.f, count), p.min_rate), 1.f);
    float away = *p.new_mean - old_mean, old_variance = old_scale * old_scale;
    float variance =
        old_variance + rate * (*p.new_variance - old_variance) + rate * (1.f - rate) * away * away;
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
