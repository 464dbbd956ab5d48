// The two convolutions of the encoder `Conv` with their ReLUs, in one kernel. Hidden activations
// never leave the registers of their thread.
//
// A block convolves a tile of 16 rows. Each of its warps computes a quarter of the columns of the
// features: it moves along the rows, with the 16 rows as the left matrix of each product, and the
// weights, in registers throughout, as the right one. Hidden column h reads columns 4 h - 4 to
// 4 h + 3 of the rows; column i of the features reads hidden columns 2 i - 2 to 2 i + 1. So step i,
// with columns 8 i to 8 i + 7 of the rows, computes hidden columns 2 i and 2 i + 1, which complete
// column i of the features and begin column i + 1.
//
// Of a 16 x 16 left matrix, a thread holds rows g and g + 8 and columns 2 q, 2 q + 1, 2 q + 8 and
// 2 q + 9, with g = lane / 4 and q = lane % 4 of the warp. In the first convolution these are the
// columns of channel q: a thread reads the rows of its own channel only. Of a 16 x 8 result it
// holds rows g and g + 8 and columns 2 q and 2 q + 1, so two results are a left matrix of the
// second convolution.
#include "tiles.h"

constexpr int ROW_THREADS = THREADS / ROWS;  // that copy a row

// Begins to copy a tile of rows. Rows that do not exist are the last one again.
DEVICE void begin_rows(Bits* target, const Bits* rows, int first_row, bool is_aligned,
                       const ConvForwardParams& p) {
    int row = threadIdx.x / ROW_THREADS, part = threadIdx.x % ROW_THREADS;
    const Bits* source = rows + (long long)min(first_row + row, p.n_rows - 1) * p.row_stride;
    target += row * p.row_size;
    for (int channel = 0; channel < p.n_channels; channel++) {
        if (is_aligned)
            for (int i = WORD * part; i < p.n_columns; i += WORD * ROW_THREADS)
                begin_copy(target + i, source + i);
        else
            for (int i = part; i < p.n_columns; i += ROW_THREADS)
                target[i] = source[i];
        source += p.n_columns;
        target += p.channel_size;
    }
    end_group();
}

DEVICE void write_features(Bits* features, const Bits* source, int first_row, int n_features,
                           const ConvForwardParams& p) {
    int row = threadIdx.x / ROW_THREADS, part = threadIdx.x % ROW_THREADS;
    if (first_row + row >= p.n_rows)
        return;
    features += (long long)(first_row + row) * p.feature_stride;
    source += row * p.feature_size;
    for (int i = WORD * part; i < n_features; i += WORD * ROW_THREADS)
        *(uint4*)(features + i) = *(const uint4*)(source + i);
}

// Sets the sums of two rows to the bias, two numbers per tile.
DEVICE void begin_sums(float (&sums)[TILES][4], const unsigned int (&bias)[TILES]) {
    for (int j = 0; j < TILES; j++) {
        sums[j][0] = sums[j][2] = low_half(bias[j]);
        sums[j][1] = sums[j][3] = high_half(bias[j]);
    }
}

// What a thread holds of the weights. N channels of the rows: 4 or 8.
template <int N>
struct ForwardWeights {
    unsigned int first[N / 4][2][TILES][2];   // by the first or last four columns that they read
    unsigned int second[4][PARTS][TILES][2];  // by hidden column
    unsigned int first_bias[TILES], second_bias[TILES];
};

template <int N>
DEVICE void load(ForwardWeights<N>& weights, const ConvForwardParams& p, int g, int q) {
    const Bits* first = (const Bits*)p.first_weight;
    const Bits* second = (const Bits*)p.second_weight;
    const Bits* first_bias = (const Bits*)p.first_bias;
    const Bits* second_bias = (const Bits*)p.second_bias;
    for (int j = 0; j < TILES; j++) {
        int feature = 8 * j + g;
        for (int n = 0; n < N / 4; n++) {
            int channel = 4 * n + q;
            uint4 taps = {0u, 0u, 0u, 0u};
            if (channel < p.n_channels)
                taps = *(const uint4*)(first + (feature * p.n_channels + channel) * 8);
            weights.first[n][0][j][0] = taps.x;
            weights.first[n][0][j][1] = taps.y;
            weights.first[n][1][j][0] = taps.z;
            weights.first[n][1][j][1] = taps.w;
        }
        for (int part = 0; part < PARTS; part++)
            for (int half = 0; half < 2; half++) {  // of the part's 16 hidden channels
                int channel = 16 * part + 8 * half + 2 * q;
                // two channels' four taps each
                uint4 pair = *(const uint4*)(second + (feature * CONV_CHANNELS + channel) * 4);
                weights.second[0][part][j][half] = __byte_perm(pair.x, pair.z, 0x5410);
                weights.second[1][part][j][half] = __byte_perm(pair.x, pair.z, 0x7632);
                weights.second[2][part][j][half] = __byte_perm(pair.y, pair.w, 0x5410);
                weights.second[3][part][j][half] = __byte_perm(pair.y, pair.w, 0x7632);
            }
        weights.first_bias[j] = *(const unsigned int*)(first_bias + 8 * j + 2 * q);
        weights.second_bias[j] = *(const unsigned int*)(second_bias + 8 * j + 2 * q);
    }
}

// A left matrix of the first convolution: four columns of this thread's channel, of both its rows.
struct Columns {
    uint2 rows[2];
};

// One hidden column, as left matrices of the second convolution.
typedef unsigned int Hidden[PARTS][4];

template <int N>
DEVICE void convolve_first(Hidden& hidden, const Columns (&left)[N / 4],
                           const Columns (&right)[N / 4], bool exists,
                           const ForwardWeights<N>& weights) {
    float sums[TILES][4];
    begin_sums(sums, weights.first_bias);
    for (int n = 0; n < N / 4; n++)
        for (int side = 0; side < 2; side++) {
            const Columns& four = side ? right[n] : left[n];
            unsigned int a[4] = {four.rows[0].x, four.rows[1].x, four.rows[0].y, four.rows[1].y};
            for (int j = 0; j < TILES; j++)
                multiply_add(sums[j], a, weights.first[n][side][j][0],
                             weights.first[n][side][j][1]);
        }
    for (int part = 0; part < PARTS; part++)
        for (int i = 0; i < 4; i++) {
            const float (&tile)[4] = sums[2 * part + (i >> 1)];
            hidden[part][i] = exists ? pack_relu(tile[2 * (i & 1)], tile[2 * (i & 1) + 1]) : 0u;
        }
}

// Adds two hidden columns' part of the features, from the first or last two of four.
template <int N>
DEVICE void convolve_second(float (&sums)[TILES][4], const Hidden (&hidden)[2], int first,
                            const ForwardWeights<N>& weights) {
    for (int h = 0; h < 2; h++)
        for (int part = 0; part < PARTS; part++)
            for (int j = 0; j < TILES; j++)
                multiply_add(sums[j], hidden[h][part], weights.second[first + h][part][j][0],
                             weights.second[first + h][part][j][1]);
}

template <int N>
DEVICE void conv_forward(const ConvForwardParams& p) {
    int warp = threadIdx.x >> 5, g = (threadIdx.x & 31) >> 2, q = threadIdx.x & 3;
    int n_hidden = p.n_columns / 4 + 1, n_outputs = n_hidden / 2 + 1;
    int n_tiles = (p.n_rows + ROWS - 1) / ROWS, n_features = CONV_CHANNELS * n_outputs;
    const Bits* rows = (const Bits*)p.rows;
    Bits* features = (Bits*)p.features;
    bool is_aligned =
        !((unsigned long long)rows % 16) && !(p.row_stride % WORD) && !(p.n_columns % WORD);
    Bits* staged = (Bits*)shared_memory;  // a tile of rows, and the next one
    Bits* outputs = staged + 2 * ROWS * p.row_size;

    begin_rows(staged, rows, ROWS * blockIdx.x, is_aligned, p);
    for (int i = threadIdx.x; i < 2 * ROWS * p.n_channels; i += THREADS) {
        Bits* channel = staged + i / p.n_channels * p.row_size + i % p.n_channels * p.channel_size;
        for (int column = p.n_columns; column < p.channel_size; column++)
            channel[column] = 0;
    }
    ForwardWeights<N> weights;
    load(weights, p, g, q);

    // this warp's columns of the features
    int first = (n_outputs * warp + WARPS - 1) / WARPS;
    int end = (n_outputs * (warp + 1) + WARPS - 1) / WARPS;
    int start = max(first - 1, 0);
    for (int tile = blockIdx.x, n = 0; tile < n_tiles; tile += gridDim.x, n++) {
        wait_for_copies<0>();
        __syncthreads();  // the rows are here, and the last tile's features are written
        Bits* next_rows = staged + (n + 1) % 2 * ROWS * p.row_size;
        if (tile + gridDim.x < n_tiles)
            begin_rows(next_rows, rows, ROWS * (tile + gridDim.x), is_aligned, p);

        const Bits* channel = staged + n % 2 * ROWS * p.row_size + g * p.row_size;
        channel += q * p.channel_size;
        auto exists = [&](int n) { return 4 * n + q < p.n_channels; };
        Columns left[N / 4];  // the four columns before those of the step
        for (int n = 0; n < N / 4; n++)
            for (int half = 0; half < 2; half++) {
                const Bits* at = channel + 8 * half * p.row_size + 4 * n * p.channel_size;
                left[n].rows[half] = {0u, 0u};
                if (start && exists(n))
                    left[n].rows[half] = *(const uint2*)(at + WORD * start - 4);
            }
        float sums[TILES][4], next_sums[TILES][4];
        begin_sums(next_sums, weights.second_bias);
        for (int i = start; i < end; i++) {
            Columns middle[N / 4], right[N / 4];
            for (int n = 0; n < N / 4; n++)
                for (int half = 0; half < 2; half++) {
                    const Bits* at = channel + 8 * half * p.row_size + 4 * n * p.channel_size;
                    uint4 word = {0u, 0u, 0u, 0u};
                    if (exists(n))
                        word = *(const uint4*)(at + WORD * i);
                    middle[n].rows[half] = {word.x, word.y};
                    right[n].rows[half] = {word.z, word.w};
                }
            Hidden hidden[2];
            convolve_first<N>(hidden[0], left, middle, 2 * i < n_hidden, weights);
            convolve_first<N>(hidden[1], middle, right, 2 * i + 1 < n_hidden, weights);
            for (int n = 0; n < N / 4; n++)
                left[n] = right[n];
            for (int j = 0; j < TILES; j++)
                for (int e = 0; e < 4; e++)
                    sums[j][e] = next_sums[j][e];
            begin_sums(next_sums, weights.second_bias);
            if (i + 1 < end)
                convolve_second(next_sums, hidden, 0, weights);
            if (i < first)
                continue;
            convolve_second(sums, hidden, 2, weights);
            for (int j = 0; j < TILES; j++)
                for (int half = 0; half < 2; half++) {
                    unsigned int pair = pack_relu(sums[j][2 * half], sums[j][2 * half + 1]);
                    Bits* at = outputs + (g + 8 * half) * p.feature_size;
                    at += (8 * j + 2 * q) * n_outputs + i;
                    at[0] = (Bits)pair;
                    at[n_outputs] = (Bits)(pair >> 16);
                }
        }
        __syncthreads();
        write_features(features, outputs, ROWS * tile, n_features, p);
    }
}

INSTANCE(__launch_bounds__(THREADS, 2) conv_forward_4, ConvForwardParams, conv_forward<4>)
INSTANCE(__launch_bounds__(THREADS, 2) conv_forward_8, ConvForwardParams, conv_forward<8>)
