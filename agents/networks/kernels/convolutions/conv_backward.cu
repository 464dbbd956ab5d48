// The gradients of the weights and biases of the encoder `Conv`, in one kernel. Hidden activations
// are computed again, and they and their gradients never leave the registers of their thread.
//
// A block handles a tile of 16 rows at a time. In the gradient of a weight, the 16 rows are the
// inner axis of the products, at one column after the other, so that no product is padded. Hidden
// column h reads columns 4 h - 4 to 4 h + 3 of the rows, and columns (h + 2) / 2 and h / 2 of the
// features read it. So step r loads column r + 1 of the gradients, and handles hidden columns 2 r
// and 2 r + 1, whose gradients depend on columns r and r + 1.
//
// A warp handles half of the hidden channels, and half of the steps. Of a 16 x 8 result, a thread
// holds rows g and g + 8 and columns 2 q and 2 q + 1, with g = lane / 4 and q = lane % 4 of the
// warp. Results have hidden channels as rows and the tile's rows as columns: two results, rounded,
// are the left matrix of the next product.
#include "tiles.h"

constexpr int HALVES = CONV_CHANNELS / 16;    // of the hidden channels
constexpr int SLICES = WARPS / HALVES;        // of the steps
constexpr int TAPS = 4;                       // of the second convolution
constexpr int COLUMN = ROWS * CONV_CHANNELS;  // numbers of a column of the gradients
constexpr unsigned int ONES = 0x3f803f80;     // a pair of them
static_assert(ROWS == 16 && HALVES == 2 && SLICES == 2 && CONV_CHANNELS == 32);

struct Thread {
    int warp, lane, g, q;
    int half;   // of the hidden channels
    int slice;  // of the steps
    // where the words are that it gives to the loads of matrices
    int gradients_of_rows, gradients_of_features, image_numbers, image_rows;
};

// Where a word of eight rows' gradients is. No two words that a warp loads at once are in the same
// banks, and few that it writes.
DEVICE int gradient_at(int feature, int word) {
    return ROWS * feature + WORD * (word ^ (feature >> 2 & 1));
}

DEVICE int column_at(int column, int gradient) {
    return COLUMN * column + (gradient ^ ROWS * (column >> 3 & 3));
}

DEVICE Thread this_thread(int image_size) {
    int warp = threadIdx.x >> 5, lane = threadIdx.x & 31;
    int row = lane & 7, odd = lane >> 3 & 1, upper = lane >> 4;  // of its matrix, of four
    Thread me = {warp, lane, lane >> 2, lane & 3, warp % HALVES, warp / HALVES};
    me.gradients_of_rows = gradient_at(row + 8 * upper, odd);
    me.gradients_of_features = gradient_at(row + 8 * odd, upper);
    me.image_numbers = (row + 8 * upper) * image_size + WORD * odd;
    me.image_rows = (row + 8 * odd) * image_size + WORD * upper;
    return me;
}

// What a thread adds up. R: pairs of input channels.
template <int R>
struct Sums {
    float second[TAPS][TILES][4];  // hidden channels x features
    float first[2][R][4];          // hidden channels x four columns of two channels; left, right
    float first_bias[4];           // hidden channels x any column
    float second_bias[2][4];       // any row x features
};

template <int R, typename F>
DEVICE void for_each(Sums<R>& sums, F f) {
    int n = 0;
    for (int e = 0; e < 4; e++) {
        for (int t = 0; t < TAPS; t++)
            for (int j = 0; j < TILES; j++)
                f(sums.second[t][j][e], n++);
        for (int side = 0; side < 2; side++)
            for (int i = 0; i < R; i++)
                f(sums.first[side][i][e], n++);
        f(sums.first_bias[e], n++);
        f(sums.second_bias[0][e], n++);
        f(sums.second_bias[1][e], n++);
    }
}

// ---- BackwardWeights ----

// What a thread holds of them, as left matrices. Rows are its half of the hidden channels.
template <int R>
struct BackwardWeights {
    unsigned int first[R][4];             // by 16 numbers of a window of the rows
    unsigned int second[TAPS][PARTS][4];  // by 16 features
    float first_bias[2];
};

template <int R>
DEVICE void load(BackwardWeights<R>& weights, const ConvBackwardParams& p, const Thread& me) {
    const Bits* first = (const Bits*)p.first_weight;
    const Bits* second = (const Bits*)p.second_weight;
    const Bits* first_bias = (const Bits*)p.first_bias;
    for (int part = 0; part < 4; part++) {
        int hidden = 16 * me.half + me.g + 8 * (part & 1);
        for (int i = 0; i < R; i++) {
            int word = 2 * i + (part >> 1), number = WORD * (word % R) + 2 * me.q;
            int channel = number >> 2, tap = 4 * (word / R) + (number & 3);
            weights.first[i][part] = 0u;
            if (channel < p.n_channels)
                weights.first[i][part] =
                    *(const unsigned int*)(first + (hidden * p.n_channels + channel) * 8 + tap);
        }
        for (int i = 0; i < PARTS; i++) {
            int feature = 16 * i + 8 * (part >> 1) + 2 * me.q;
            const Bits* at = second + (feature * CONV_CHANNELS + hidden) * TAPS;
            uint2 taps = *(const uint2*)at, next = *(const uint2*)(at + CONV_CHANNELS * TAPS);
            weights.second[0][i][part] = __byte_perm(taps.x, next.x, 0x5410);
            weights.second[1][i][part] = __byte_perm(taps.x, next.x, 0x7632);
            weights.second[2][i][part] = __byte_perm(taps.y, next.y, 0x5410);
            weights.second[3][i][part] = __byte_perm(taps.y, next.y, 0x7632);
        }
    }
    for (int e = 0; e < 2; e++)
        weights.first_bias[e] = low_half(first_bias[16 * me.half + me.g + 8 * e]);
}

// ---- Tiles ----

struct Tile {
    Arrivals* arrivals;  // of d_features and features
    Bits* d_features;    // as they are in global memory
    Bits* features;
    Bits* gradients;  // before the second ReLU: 16 rows of each feature of each column
    Bits* places;     // where the gradients of each of a row's features are
    Bits* images;     // of two tiles, this one and the next
};

// Where four columns of a channel are in a row in shared memory. Block b has columns 4 b - 4 to
// 4 b - 1 of 2 R channels. What the rows do not have is 0. Hidden column h reads blocks h and h
// + 1.
template <int R>
DEVICE int image_at(int block, int channel) {
    return 2 * R * 4 * block + 4 * channel;
}

// Announces the bytes of a tile's features, before any thread copies them.
DEVICE void expect_tile(const Tile& tile, int first_row, int n_features,
                        const ConvBackwardParams& p) {
    int n_rows = min(p.n_rows - first_row, ROWS);
    if (!threadIdx.x)
        expect(tile.arrivals, 2 * n_rows * n_features * (int)sizeof(Bits));
}

// Begins to copy a tile, a quarter of the rows per warp. Rows that do not exist are 0.
template <int R>
DEVICE void begin_tile(const Tile& tile, Bits* images, int first_row, int n_features,
                       const ConvBackwardParams& p, const Thread& me) {
    long long first = first_row;
    int n_rows = min(p.n_rows - first_row, ROWS);
    if (me.lane < 2 * ROWS / WARPS) {  // a row of one of two arrays
        int row = me.warp + WARPS * (me.lane >> 1);
        bool is_d = me.lane & 1;
        const Bits* source = is_d ? (const Bits*)p.d_features + (first + row) * p.d_stride
                                  : (const Bits*)p.features + (first + row) * p.feature_stride;
        Bits* target = (is_d ? tile.d_features : tile.features) + row * p.staged_size;
        if (row < n_rows)
            begin_copy(target, source, n_features * (int)sizeof(Bits), tile.arrivals);
        else
            for (int i = 0; i < n_features; i += WORD)
                *(uint4*)(target + i) = {0u, 0u, 0u, 0u};
    }
    const Bits* rows = (const Bits*)p.rows + (first + me.warp) * p.row_stride;
    images += me.warp * p.image_size;
    if ((unsigned long long)p.rows % 8 || p.row_stride % 4 || p.n_columns % 4)
        for (int row = me.warp; row < ROWS; row += WARPS) {
            for (int i = me.lane; i < p.n_channels * p.n_columns; i += 32) {
                int channel = i / p.n_columns, column = i % p.n_columns;
                images[image_at<R>(column / 4 + 1, channel) + column % 4] =
                    row < n_rows ? rows[i] : (Bits)0;
            }
            rows += WARPS * p.row_stride;
            images += WARPS * p.image_size;
        }
    else
        for (int channel = 0; channel < p.n_channels; channel++)
            for (int i = me.lane; i < p.n_columns / 4; i += 32) {
                const Bits* source = rows + channel * p.n_columns + 4 * i;
                Bits* target = images + image_at<R>(i + 1, channel);
                for (int n = 0; n < ROWS / WARPS; n++) {
                    begin_copy_or_clear<8>(target, source, me.warp + WARPS * n < n_rows);
                    source += WARPS * p.row_stride;
                    target += WARPS * p.image_size;
                }
            }
    end_group();
}

// Clears the gradients where the features are not above 0, and transposes them. A thread handles
// eight numbers of two rows.
DEVICE void transpose(const Tile& tile, int n_features, const ConvBackwardParams& p,
                      const Thread& me) {
    int row = 2 * me.g;
    for (int i = 4 * me.warp + me.q; i < n_features / WORD; i += 4 * WARPS) {
        unsigned int pairs[2][4];
        for (int e = 0; e < 2; e++) {
            int at = (row + e) * p.staged_size + WORD * i;
            uint4 d = *(const uint4*)(tile.d_features + at);
            uint4 features = *(const uint4*)(tile.features + at);
            pairs[e][0] = where_active(features.x, d.x);
            pairs[e][1] = where_active(features.y, d.y);
            pairs[e][2] = where_active(features.z, d.z);
            pairs[e][3] = where_active(features.w, d.w);
        }
        uint4 places = *(const uint4*)(tile.places + WORD * i);
        unsigned int of_pairs[4] = {places.x, places.y, places.z, places.w};
        for (int n = 0; n < WORD; n++) {
            bool odd = n & 1;
            unsigned int at = odd ? of_pairs[n >> 1] >> 16 : of_pairs[n >> 1] & 0xffff;
            *(unsigned int*)(tile.gradients + (at ^ row)) =
                __byte_perm(pairs[0][n >> 1], pairs[1][n >> 1], odd ? 0x7632 : 0x5410);
        }
    }
}

// One column of the gradients, as right matrices.
struct Column {
    unsigned int of_rows[TILES][2];         // rows x 8 features
    unsigned int of_features[PARTS][2][2];  // 16 features x 8 rows
};

DEVICE void load_column(Column& column, const Bits* gradients, int i, const Thread& me) {
    const Bits* of_rows = gradients + column_at(i, me.gradients_of_rows);
    const Bits* of_features = gradients + column_at(i, me.gradients_of_features);
    for (int n = 0; n < PARTS; n++) {
        load_matrices(column.of_rows[2 * n], column.of_rows[2 * n + 1], of_rows + 16 * ROWS * n);
        load_transposed(column.of_features[n][0], column.of_features[n][1],
                        of_features + 16 * ROWS * n);
    }
}

// One block of the images, as right matrices.
template <int R>
struct Block {
    unsigned int of_numbers[2][R];  // parts of 8 numbers x 8 rows
    unsigned int of_rows[R][2];     // rows x 8 numbers
};

template <int R>
DEVICE void load_block(Block<R>& block, const Bits* images, int i, const Thread& me) {
    images += image_at<R>(i, 0);
    for (int n = 0; n + 1 < R; n += 2) {
        unsigned int first[2], second[2];  // of eight rows each
        load_matrices(first, second, images + me.image_numbers + WORD * n);
        for (int e = 0; e < 2; e++) {
            block.of_numbers[0][n + e] = first[e];
            block.of_numbers[1][n + e] = second[e];
        }
        load_transposed(block.of_rows[n], block.of_rows[n + 1], images + me.image_rows + WORD * n);
    }
    if (R % 2) {  // lanes 0 to 15 give the rows
        unsigned int halves[2];
        const Bits* last = images + me.image_rows + WORD * (R - 1);
        load_matrices(halves, last);
        block.of_numbers[0][R - 1] = halves[0];
        block.of_numbers[1][R - 1] = halves[1];
        load_transposed(block.of_rows[R - 1], last);
    }
}

// ---- Gradients ----

// Handles one hidden column, which two columns of the features read. `parity`: of its number.
// `is_last`: only one of the two exists, as for the last of an odd number of hidden columns.
template <int R, int parity, bool is_last>
DEVICE void add_hidden(Sums<R>& sums, const BackwardWeights<R>& weights, const Column& column,
                       const Column& next_column, const Block<R>& left, const Block<R>& right) {
    float d_sums[2][4] = {};  // by half of the rows
    for (int part = 0; part < PARTS; part++)
        for (int half = 0; half < 2; half++) {
            const unsigned int (&now)[2] = column.of_features[part][half];
            const unsigned int (&next)[2] = next_column.of_features[part][half];
            multiply_add(d_sums[half], weights.second[parity + 2][part], now[0], now[1]);
            if (!is_last)
                multiply_add(d_sums[half], weights.second[parity][part], next[0], next[1]);
        }

    float hidden_sums[2][4];
    for (int half = 0; half < 2; half++) {
        for (int e = 0; e < 4; e++)
            hidden_sums[half][e] = weights.first_bias[e >> 1];
        for (int i = 0; i < R; i++) {
            unsigned int words[2];
            for (int e = 0; e < 2; e++) {
                int word = 2 * i + e;
                words[e] =
                    word < R ? left.of_numbers[half][word % R] : right.of_numbers[half][word % R];
            }
            multiply_add(hidden_sums[half], weights.first[i], words[0], words[1]);
        }
    }

    unsigned int hidden[4], d_hidden[4];
    for (int part = 0; part < 4; part++) {
        int half = part >> 1, e = 2 * (part & 1);
        hidden[part] = pack_relu(hidden_sums[half][e], hidden_sums[half][e + 1]);
        d_hidden[part] =
            where_active(hidden[part], pack_bfloat16(d_sums[half][e], d_sums[half][e + 1]));
    }
    for (int j = 0; j < TILES; j++) {
        multiply_add(sums.second[parity + 2][j], hidden, column.of_rows[j][0],
                     column.of_rows[j][1]);
        if (!is_last)
            multiply_add(sums.second[parity][j], hidden, next_column.of_rows[j][0],
                         next_column.of_rows[j][1]);
    }
    for (int i = 0; i < R; i++) {
        multiply_add(sums.first[0][i], d_hidden, left.of_rows[i][0], left.of_rows[i][1]);
        multiply_add(sums.first[1][i], d_hidden, right.of_rows[i][0], right.of_rows[i][1]);
    }
    multiply_add(sums.first_bias, d_hidden, ONES, ONES);
}

// Adds a column of the gradients to the bias of this warp's half of the features.
template <int R>
DEVICE void add_bias(Sums<R>& sums, const Column& column, const Thread& me) {
    const unsigned int ones[4] = {ONES, ONES, ONES, ONES};
    for (int j = 0; j < TILES / HALVES; j++) {
        unsigned int first = me.half ? column.of_rows[TILES / 2 + j][0] : column.of_rows[j][0];
        unsigned int second = me.half ? column.of_rows[TILES / 2 + j][1] : column.of_rows[j][1];
        multiply_add(sums.second_bias[j], ones, first, second);
    }
}

// Writes a block's sums, of which this thread has a part.
template <int R>
DEVICE void write(const Sums<R>& sums, float* target, int n_channels, const Thread& me) {
    float* first_bias = target + CONV_CHANNELS * n_channels * 8;
    float* second = first_bias + CONV_CHANNELS;
    float* second_bias = second + CONV_CHANNELS * CONV_CHANNELS * TAPS;
    for (int e = 0; e < 4; e++) {
        int hidden = 16 * me.half + me.g + 8 * (e >> 1), column = 2 * me.q + (e & 1);
        for (int side = 0; side < 2; side++)
            for (int i = 0; i < R; i++) {
                int channel = 2 * i + column / 4, tap = 4 * side + column % 4;
                if (channel < n_channels)
                    target[(hidden * n_channels + channel) * 8 + tap] = sums.first[side][i][e];
            }
        for (int j = 0; j < TILES; j++)
            *(float4*)(second + ((8 * j + column) * CONV_CHANNELS + hidden) * TAPS) = {
                sums.second[0][j][e], sums.second[1][j][e], sums.second[2][j][e],
                sums.second[3][j][e]};
        if (!me.q && !(e & 1))
            first_bias[hidden] = sums.first_bias[e];
        if (!me.g && e < 2)
            for (int j = 0; j < TILES / HALVES; j++)
                second_bias[16 * me.half + 8 * j + column] = sums.second_bias[j][e];
    }
}

template <int R>
DEVICE void conv_backward(const ConvBackwardParams& p) {
    Thread me = this_thread(p.image_size);
    int n_hidden = p.n_columns / 4 + 1, n_outputs = n_hidden / 2 + 1;
    int n_tiles = (p.n_rows + ROWS - 1) / ROWS, n_features = CONV_CHANNELS * n_outputs;
    Tile tile;
    tile.arrivals = (Arrivals*)shared_memory;
    tile.d_features = (Bits*)shared_memory + WORD;
    tile.features = tile.d_features + ROWS * p.staged_size;
    tile.gradients = tile.features + ROWS * p.staged_size;
    tile.places = tile.gradients + COLUMN * n_outputs;
    tile.images = tile.places + n_features;

    for (int i = threadIdx.x; i < 2 * ROWS * p.image_size / WORD; i += THREADS)
        ((uint4*)tile.images)[i] = {0u, 0u, 0u, 0u};
    for (int i = threadIdx.x; i < n_features; i += THREADS)
        tile.places[i] = column_at(i % n_outputs, gradient_at(i / n_outputs, 0));
    bool has_tile = blockIdx.x < n_tiles;
    if (!threadIdx.x)
        init(tile.arrivals);
    if (has_tile)
        expect_tile(tile, ROWS * blockIdx.x, n_features, p);
    __syncthreads();
    if (has_tile)
        begin_tile<R>(tile, tile.images, ROWS * blockIdx.x, n_features, p, me);
    BackwardWeights<R> weights;
    load(weights, p, me);
    Sums<R> sums;
    for_each(sums, [](float& sum, int) { sum = 0.f; });

    // this warp's steps
    int n_steps = n_hidden / 2;
    int first = n_steps * me.slice / SLICES, end = n_steps * (me.slice + 1) / SLICES;
    for (int i = blockIdx.x, n = 0; i < n_tiles; i += gridDim.x, n++) {
        wait_for_copies<0>();
        wait_for(tile.arrivals, n);
        __syncthreads();  // the tile is here, and no warp reads the last one's gradients
        transpose(tile, n_features, p, me);
        int next_row = ROWS * (i + gridDim.x);
        bool has_next = i + gridDim.x < n_tiles;
        if (has_next)
            expect_tile(tile, next_row, n_features, p);
        __syncthreads();
        if (has_next)
            begin_tile<R>(tile, tile.images + (n + 1) % 2 * ROWS * p.image_size, next_row,
                          n_features, p, me);

        const Bits* images = tile.images + n % 2 * ROWS * p.image_size;
        Column column;
        load_column(column, tile.gradients, first, me);
        if (!me.slice)
            add_bias(sums, column, me);
        Block<R> left;
        load_block(left, images, 2 * first, me);
        for (int step = first; step < end; step++) {
            Column next_column;
            Block<R> middle, right;
            load_column(next_column, tile.gradients, step + 1, me);
            load_block(middle, images, 2 * step + 1, me);
            load_block(right, images, 2 * step + 2, me);
            add_bias(sums, next_column, me);
            add_hidden<R, 0, false>(sums, weights, column, next_column, left, middle);
            add_hidden<R, 1, false>(sums, weights, column, next_column, middle, right);
            column = next_column;
            left = right;
        }
        if (me.slice && n_hidden % 2) {
            Block<R> right;
            load_block(right, images, n_hidden, me);
            add_hidden<R, 0, true>(sums, weights, column, column, left, right);
        }
    }

    // the sums over the first slice of the steps, and over the second
    __syncthreads();
    float* of_threads = (float*)tile.d_features + 32 * me.half + me.lane;
    if (me.slice)
        for_each(sums, [&](float& sum, int n) { of_threads[32 * HALVES * n] = sum; });
    __syncthreads();
    if (me.slice)
        return;
    for_each(sums, [&](float& sum, int n) { sum += of_threads[32 * HALVES * n]; });
    int n_sums = CONV_CHANNELS * (p.n_channels * 8 + 1 + CONV_CHANNELS * TAPS + 1);
    long long block = blockIdx.x;
    write(sums, p.sums + block * n_sums, p.n_channels, me);
}

INSTANCE(__launch_bounds__(THREADS, 2) conv_backward_2, ConvBackwardParams, conv_backward<1>)
INSTANCE(__launch_bounds__(THREADS, 2) conv_backward_4, ConvBackwardParams, conv_backward<2>)
INSTANCE(__launch_bounds__(THREADS, 2) conv_backward_6, ConvBackwardParams, conv_backward<3>)
INSTANCE(__launch_bounds__(THREADS, 2) conv_backward_8, ConvBackwardParams, conv_backward<4>)
