// The intake of observations: normalises all leaves, selects lanes, concatenates, rounds. A thread
// handles four columns of several rows, so that it reads their statistics once.
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

// Where a feature is: its leaf, and its number in it. Features beyond the leaves have number -1.
struct Feature : IntakeLeafParams {
    int number;
};

DEVICE Feature find(const NormaliseParams& p, int number) {
    Feature feature = {p.leaves[0], -1};
    for (int i = 0; i < MAX_LEAVES; i++) {
        if (number >= 0 && number < p.leaves[i].n_features)
            feature = {p.leaves[i], number};
        number -= p.leaves[i].n_features;
    }
    return feature;
}

struct Rows {
    unsigned int source[NORMALISED_ROWS], target[NORMALISED_ROWS];
    bool exists[NORMALISED_ROWS];
};

DEVICE void write_row(const NormaliseParams& p, const Rows& rows, int i, int column,
                      const float (&values)[4]) {
    if (rows.exists[i])
        write<Bfloat16>(p.features, (long long)rows.target[i] * p.n_columns + column, values);
}

// Four features of one leaf with one mean and scale, which a word holds.
template <class Word>
DEVICE void normalise_word(const NormaliseParams& p, const Rows& rows, int column,
                           const Feature& feature) {
    float means[4], scales[4];
    for (int n = 0; n < 4; n++) {
        int at = (feature.number + n) / feature.group;
        means[n] = feature.mean[at];
        scales[n] = feature.scale[at];
    }
    Word words[NORMALISED_ROWS];
    const Word* first = (const Word*)feature.values + feature.number / 4;
    for (int i = 0; i < NORMALISED_ROWS; i++)
        words[i] = first[(long long)rows.source[i] * (feature.n_features / 4)];
    for (int n = 0; n < 4; n++)
        scales[n] = __fdiv_rn(1.f, scales[n]);
    for (int i = 0; i < NORMALISED_ROWS; i++) {
        float values[4];
        unpack(values, words[i]);
        for (int n = 0; n < 4; n++)
            values[n] = (values[n] - means[n]) * scales[n];
        write_row(p, rows, i, column, values);
    }
}

DEVICE void normalise_features(const NormaliseParams& p, const Rows& rows, int column) {
    float values[NORMALISED_ROWS][4];
    for (int n = 0; n < 4; n++) {
        Feature feature = find(p, column + n);
        int number = max(feature.number, 0), at = number / feature.group;
        float mean = feature.mean[at], scale = feature.scale[at];
        const unsigned short* halves = (const unsigned short*)feature.values;
        // a float as two halves, so that no load depends on a branch
        unsigned int low[NORMALISED_ROWS], high[NORMALISED_ROWS];
        for (int i = 0; i < NORMALISED_ROWS; i++) {
            long long first = (long long)rows.source[i] * feature.n_features + number;
            first = feature.is_half ? first : 2 * first;
            low[i] = halves[first];
            high[i] = halves[feature.is_half ? first : first + 1];
        }
        for (int i = 0; i < NORMALISED_ROWS; i++) {
            float value =
                feature.is_half ? half_value(low[i]) : __uint_as_float(high[i] << 16 | low[i]);
            value = (value - mean) * __fdiv_rn(1.f, scale);
            values[i][n] = feature.number < 0 ? 0.f : value;
        }
    }
    for (int i = 0; i < NORMALISED_ROWS; i++)
        write_row(p, rows, i, column, values[i]);
}

// Blocks along y: steps.
KERNEL __launch_bounds__(64) normalise(NormaliseParams p) {
    wait_for_previous();
    unsigned int thread = blockIdx.x * blockDim.x + threadIdx.x, n_words = p.n_columns / 4;
    unsigned int n_selected = p.n_selected, n_plain = p.n_plain_words;
    unsigned int step = (n_selected + NORMALISED_ROWS - 1) / NORMALISED_ROWS;  // between two rows
    // Other words take several times as long, so they have warps of their own.
    bool is_plain = thread < step * n_plain;
    unsigned int number = is_plain ? thread : thread - step * n_plain;
    unsigned int words = is_plain ? n_plain : n_words - n_plain;
    if (!words)
        return;
    unsigned int first = number / words, word = number - first * words + (is_plain ? 0 : n_plain);
    unsigned int column = 4 * word;
    if (first >= step)
        return;
    Rows rows;
    for (int i = 0; i < NORMALISED_ROWS; i++) {
        unsigned int m = min(first + i * step, n_selected - 1);
        unsigned int lane = p.lanes ? (unsigned int)p.lanes[m] : m;
        rows.exists[i] = first + i * step < n_selected;
        rows.source[i] = blockIdx.y * p.n_lanes + lane;
        rows.target[i] = blockIdx.y * n_selected + m;
    }
    Feature feature = find(p, column);
    bool is_word = feature.number >= 0 && feature.number % 4 == 0 && feature.n_features % 4 == 0;
    bool is_aligned = (unsigned long long)feature.values % (feature.is_half ? 8 : 16) == 0;
    if (is_word && is_aligned && feature.is_half)
        normalise_word<uint2>(p, rows, column, feature);
    else if (is_word && is_aligned)
        normalise_word<uint4>(p, rows, column, feature);
    else
        normalise_features(p, rows, column);
}
