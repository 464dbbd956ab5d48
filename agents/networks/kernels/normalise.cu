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
    float mean, inverse;  // of the scale
};

DEVICE bool find(Column& column, const IntakeLeafParams& leaf, long long policy, int& feature) {
    if (feature >= leaf.n_features) {
        feature -= leaf.n_features;
        return false;
    }
    int size = leaf.is_half ? 2 : 4;
    long long statistic = policy * (leaf.n_features / leaf.group) + feature / leaf.group;
    column = {(const char*)leaf.values + feature * size, leaf.n_features * size, leaf.is_half,
              leaf.mean[statistic], __fdiv_rn(1.f, leaf.scale[statistic])};
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

DEVICE float value_at(const Column& column, unsigned int row) {
    if (!column.values)
        return 0.f;
    const char* address = column.values + (unsigned long long)row * column.stride;
    return column.is_half ? half_value(*(const unsigned short*)address) : *(const float*)address;
}

// Blocks along y: steps of all policies.
template <class T>
DEVICE void normalise(const NormaliseParams& p) {
    unsigned int thread = blockIdx.x * blockDim.x + threadIdx.x, n_words = p.n_columns / 4;
    unsigned int n_selected = p.n_selected;
    unsigned int step = (n_selected + NORMALISED_ROWS - 1) / NORMALISED_ROWS;  // between two rows
    unsigned int first = thread / n_words, word = thread - first * n_words;
    if (first >= step)
        return;
    unsigned int policy = blockIdx.y / p.n_steps, row_of_step = blockIdx.y * p.n_lanes;
    Column columns[4];
#pragma unroll
    for (int n = 0; n < 4; n++)
        columns[n] = column_at(p, policy, 4 * word + n);
    // four neighbours in 8 bytes
    bool is_word = columns[0].is_half && columns[3].values == columns[0].values + 6 &&
                   columns[0].stride == columns[3].stride && columns[0].stride % 8 == 0 &&
                   (unsigned long long)columns[0].values % 8 == 0;
    float values[NORMALISED_ROWS][4];
#pragma unroll
    for (int i = 0; i < NORMALISED_ROWS; i++) {
        unsigned int m = min(first + i * step, n_selected - 1);
        unsigned int row = row_of_step + (p.lanes ? p.lanes[policy * n_selected + m] : m);
        if (is_word) {
            uint2 bits =
                *(const uint2*)(columns[0].values + (unsigned long long)row * columns[0].stride);
            values[i][0] = half_value(bits.x & 0xffff);
            values[i][1] = half_value(bits.x >> 16);
            values[i][2] = half_value(bits.y & 0xffff);
            values[i][3] = half_value(bits.y >> 16);
        } else
#pragma unroll
            for (int n = 0; n < 4; n++)
                values[i][n] = value_at(columns[n], row);
    }
#pragma unroll
    for (int i = 0; i < NORMALISED_ROWS; i++) {
        unsigned int m = first + i * step;
        if (m >= n_selected)
            break;
#pragma unroll
        for (int n = 0; n < 4; n++)
            values[i][n] = (values[i][n] - columns[n].mean) * columns[n].inverse;
        long long row = (long long)blockIdx.y * n_selected + m;
        write<T>(p.features, row * p.n_columns + 4 * word, values[i]);
    }
}

KERNEL BOUNDS(64) normalise_float32(NormaliseParams p) { normalise<float>(p); }
KERNEL BOUNDS(64) normalise_bfloat16(NormaliseParams p) { normalise<Bfloat16>(p); }
