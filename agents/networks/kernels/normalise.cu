// The intake of observations: normalises all leaves, selects lanes, concatenates, rounds. A thread
// handles four columns of several rows, so that it reads their statistics once.
#include "constants.h"
#include "lanes.h"
#include "params.h"

DEVICE float half_value(unsigned short bits) {
    float x;
    asm("cvt.f32.f16 %0, %1;" : "=f"(x) : "h"(bits));
    return x;
}

// One column of the result: which numbers it comes from, and their statistics.
struct Column {
    const char* values;  // null: there is no such feature
    int stride, is_half;
    float mean, scale;
};

DEVICE bool find(Column& column, const IntakeLeafParams& leaf, long long policy, int& feature) {
    if (feature >= leaf.n_features) {
        feature -= leaf.n_features;
        return false;
    }
    int size = leaf.is_half ? 2 : 4;
    long long statistic = policy * (leaf.n_features / leaf.group) + feature / leaf.group;
    column = {(const char*)leaf.values + feature * size, leaf.n_features * size, leaf.is_half,
              leaf.mean[statistic], leaf.scale[statistic]};
    return true;
}

DEVICE Column column_at(const NormaliseParams& p, long long policy, int feature) {
    Column column = {nullptr, 0, 0, 0.f, 1.f};
    bool is_found = false;
#pragma unroll
    for (int i = 0; i < MAX_LEAVES; i++)
        is_found = is_found || find(column, p.leaves[i], policy, feature);
    return column;
}

DEVICE float value_at(const Column& column, long long row) {
    if (!column.values)
        return 0.f;
    const char* address = column.values + row * column.stride;
    return column.is_half ? half_value(*(const unsigned short*)address) : *(const float*)address;
}

template <class T>
DEVICE void normalise(const NormaliseParams& p) {
    unsigned int thread = blockIdx.x * blockDim.x + threadIdx.x, n_words = p.n_columns / 4;
    unsigned int n_rows = p.n_steps * p.n_selected;
    unsigned int step = (n_rows + NORMALISED_ROWS - 1) / NORMALISED_ROWS;  // between two rows
    unsigned int first = thread / n_words, word = thread % n_words;
    if (first >= step)
        return;
    long long policy = blockIdx.y;
    Column columns[4];
#pragma unroll
    for (int n = 0; n < 4; n++)
        columns[n] = column_at(p, policy, 4 * word + n);
    // four neighbours in 8 bytes
    bool is_word = columns[0].is_half && columns[3].values == columns[0].values + 6 &&
                   columns[0].stride == columns[3].stride && columns[0].stride % 8 == 0 &&
                   (long long)columns[0].values % 8 == 0;
    float values[NORMALISED_ROWS][4];
#pragma unroll
    for (int i = 0; i < NORMALISED_ROWS; i++) {
        unsigned int row = first + i * step;
        if (row >= n_rows)
            break;
        unsigned int t = row / p.n_selected, m = row % p.n_selected;
        long long lane = p.lanes ? p.lanes[policy * p.n_selected + m] : m;
        long long source = (policy * p.n_steps + t) * p.n_lanes + lane;
        if (is_word) {
            uint2 bits = *(const uint2*)(columns[0].values + source * columns[0].stride);
            values[i][0] = half_value(bits.x & 0xffff);
            values[i][1] = half_value(bits.x >> 16);
            values[i][2] = half_value(bits.y & 0xffff);
            values[i][3] = half_value(bits.y >> 16);
        } else
#pragma unroll
            for (int n = 0; n < 4; n++)
                values[i][n] = value_at(columns[n], source);
    }
#pragma unroll
    for (int i = 0; i < NORMALISED_ROWS; i++) {
        unsigned int row = first + i * step;
        if (row >= n_rows)
            break;
#pragma unroll
        for (int n = 0; n < 4; n++)
            values[i][n] = __fdiv_rn(values[i][n] - columns[n].mean, columns[n].scale);
        write<T>(p.features, (policy * n_rows + row) * p.n_columns + 4 * word, values[i]);
    }
}

KERNEL normalise_float32(NormaliseParams p) { normalise<float>(p); }
KERNEL normalise_bfloat16(NormaliseParams p) { normalise<Bfloat16>(p); }
