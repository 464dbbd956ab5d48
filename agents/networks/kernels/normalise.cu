// The intake of observations: normalises all leaves, selects lanes, concatenates, rounds. One thread
// per four columns of a row.
#include "lanes.h"
#include "params.h"

DEVICE float half_value(unsigned short bits) {
    float x;
    asm("cvt.f32.f16 %0, %1;" : "=f"(x) : "h"(bits));
    return x;
}

DEVICE float normalised(const IntakeLeafParams& leaf, long long policy, long long row, int feature) {
    long long at = row * leaf.n_features + feature;
    float value = leaf.is_half ? half_value(((const unsigned short*)leaf.values)[at])
                               : ((const float*)leaf.values)[at];
    long long statistic = policy * (leaf.n_features / leaf.group) + feature / leaf.group;
    return __fdiv_rn(value - leaf.mean[statistic], leaf.scale[statistic]);
}

DEVICE float feature_at(const NormaliseParams& p, long long policy, long long row, int column) {
    if (column < p.leaf0.n_features)
        return normalised(p.leaf0, policy, row, column);
    column -= p.leaf0.n_features;
    if (column < p.leaf1.n_features)
        return normalised(p.leaf1, policy, row, column);
    column -= p.leaf1.n_features;
    if (column < p.leaf2.n_features)
        return normalised(p.leaf2, policy, row, column);
    column -= p.leaf2.n_features;
    if (column < p.leaf3.n_features)
        return normalised(p.leaf3, policy, row, column);
    return 0.f;
}

template <class T>
DEVICE void normalise(const NormaliseParams& p) {
    unsigned int thread = blockIdx.x * blockDim.x + threadIdx.x;
    unsigned int n_words = p.n_columns / 4, row = thread / n_words, column = thread % n_words * 4;
    if (row >= (unsigned int)(p.n_steps * p.n_selected))
        return;
    long long policy = blockIdx.y;
    unsigned int t = row / p.n_selected, m = row % p.n_selected;
    long long lane = p.lanes ? p.lanes[policy * p.n_selected + m] : m;
    long long source = (policy * p.n_steps + t) * p.n_lanes + lane;
    float values[4];
#pragma unroll
    for (int n = 0; n < 4; n++)
        values[n] = feature_at(p, policy, source, column + n);
    long long target = policy * p.n_steps * p.n_selected + row;
    write<T>(p.features, target * p.n_columns + column, values);
}

KERNEL normalise_float32(NormaliseParams p) { normalise<float>(p); }
KERNEL normalise_bfloat16(NormaliseParams p) { normalise<Bfloat16>(p); }
