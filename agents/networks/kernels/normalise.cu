// The intake of observations: normalises all leaves, selects lanes, concatenates, rounds. A thread
// handles four columns, or one, of several rows, so that it reads their statistics once.
#include "common/numbers.h"
#include "params.h"

DEVICE void unpack(float (&values)[4], uint2 word) {
    values[0] = half_value(word.x & 0xffff);
    values[1] = half_value(word.x >> 16);
    values[2] = half_value(word.y & 0xffff);
    values[3] = half_value(word.y >> 16);
}

DEVICE void unpack(float (&values)[4], uint4 word) {
    values[0] = __uint_as_float(word.x);
    values[1] = __uint_as_float(word.y);
    values[2] = __uint_as_float(word.z);
    values[3] = __uint_as_float(word.w);
}

DEVICE void unpack(float (&values)[1], unsigned short word) { values[0] = half_value(word); }

DEVICE void unpack(float (&values)[1], float word) { values[0] = word; }

// N features of one leaf, which a word holds, in rows `first`, `first` + stride, and so on.
template <class Word, int N>
DEVICE void normalise_words(const NormaliseParams& p, const IntakeLeafParams& leaf,
                            unsigned int number, unsigned int column, unsigned int first) {
    unsigned int rows[NORMALISED_ROWS], n_words = leaf.n_features / N;
    Word words[NORMALISED_ROWS];
    auto load_from = [&](unsigned int row) {
        unsigned int sources[NORMALISED_ROWS];
        for (int i = 0; i < NORMALISED_ROWS; i++)  // beyond the end, the last row again
            sources[i] = rows[i] = min(row + i * p.stride, p.n_rows - 1);
        if (p.lanes)
            for (int i = 0; i < NORMALISED_ROWS; i++) {
                unsigned int t = rows[i] / p.n_selected;
                sources[i] = t * p.n_lanes + (unsigned int)p.lanes[rows[i] - t * p.n_selected];
            }
        for (int i = 0; i < NORMALISED_ROWS; i++)
            words[i] = ((const Word*)leaf.values)[(long long)sources[i] * n_words + number / N];
    };
    load_from(first);
    float means[N], scales[N];
    unsigned int at = number / leaf.group, n_left = leaf.group - (number - at * leaf.group);
    for (int n = 0; n < N; n++) {
        means[n] = leaf.mean[at];
        scales[n] = leaf.scale[at];
        if (!--n_left) {
            at++;
            n_left = leaf.group;
        }
    }
    for (int n = 0; n < N; n++)
        scales[n] = __fdiv_rn(1.f, scales[n]);
    for (unsigned int row = first; row < p.n_rows; row += NORMALISED_ROWS * p.stride) {
        if (row != first)
            load_from(row);
        for (int i = 0; i < NORMALISED_ROWS; i++) {
            float values[N];
            unpack(values, words[i]);
            for (int n = 0; n < N; n++)
                values[n] = (values[n] - means[n]) * scales[n];
            write<Bfloat16>(p.features, (long long)rows[i] * p.n_columns + column, values);
        }
    }
}

KERNEL __launch_bounds__(64, NORMALISED_BLOCKS) normalise(NormaliseParams p) {
    wait_for_previous();
    unsigned int thread = blockIdx.x * blockDim.x + threadIdx.x, n_plain = p.n_plain_words;
    // First threads for words of four columns, then for each other column.
    bool is_plain = thread < p.stride * n_plain;
    unsigned int n = is_plain ? n_plain : p.n_columns - 4 * n_plain;  // words, or columns
    if (!n)
        return;
    thread -= is_plain ? 0 : p.stride * n_plain;
    unsigned int first = thread / n, column = thread - first * n;
    column = is_plain ? 4 * column : 4 * n_plain + column;
    if (first >= p.stride)
        return;
    unsigned int i = 0, number = column;
    while (i < MAX_LEAVES && number >= p.leaves[i].n_features)
        number -= p.leaves[i++].n_features;
    if (i == MAX_LEAVES) {  // beyond the leaves
        float zero[1] = {0.f};
        for (unsigned int row = first; row < p.n_rows; row += p.stride)
            write<Bfloat16>(p.features, row * (long long)p.n_columns + column, zero);
        return;
    }
    const IntakeLeafParams& leaf = p.leaves[i];
    if (is_plain && leaf.is_half)
        normalise_words<uint2, 4>(p, leaf, number, column, first);
    else if (is_plain)
        normalise_words<uint4, 4>(p, leaf, number, column, first);
    else if (leaf.is_half)
        normalise_words<unsigned short, 1>(p, leaf, number, column, first);
    else
        normalise_words<float, 1>(p, leaf, number, column, first);
}
