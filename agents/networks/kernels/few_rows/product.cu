// Matrix products of few rows, in blocks that leave a multiprocessor to several others.
//
// A block computes 64 x 64 results, a warp 32 x 32 of them. Steps of 64 numbers of the inner axis
// are copied to shared memory, one while the one before is multiplied. A matrix is copied as it is
// in memory, and transposed as it is loaded from there.
#include "common/tensor_cores.h"
#include "params.h"

constexpr int ROW = TILE + 8;  // numbers from a row to the next, so that rows are in other banks
constexpr int MATRIX = TILE * ROW;
constexpr int WARP_TILE = 32;

static_assert(TILE_BYTES == 2 * 2 * MATRIX * sizeof(Bits), "two steps of two matrices");
static_assert(TILE_THREADS == 32 * (TILE / WARP_TILE) * (TILE / WARP_TILE), "warps fill a block");

extern __shared__ __align__(128) unsigned char shared_memory[];

// One of the two matrices: `n` rows of the left one, or columns of the right one, from `first` on.
struct Side {
    const Bits* numbers;
    long long stride;
    int first, n;
};

// Begins to copy 64 numbers of the inner axis. If they are its rows in memory, the matrix is
// transposed. What does not exist is 0.
template <bool is_transposed>
DEVICE void begin_matrix(Bits* target, const Side& side, int first_inner, int end) {
#pragma unroll
    for (int i = threadIdx.x; i < TILE * TILE / 8; i += TILE_THREADS) {
        int row = i / (TILE / 8), column = i % (TILE / 8) * 8;
        int outer = side.first + (is_transposed ? column : row);
        int inner = first_inner + (is_transposed ? row : column);
        bool exists = outer < side.n && inner < end;
        long long at = is_transposed ? inner * side.stride + outer : outer * side.stride + inner;
        begin_copy_or_clear<16>(target + row * ROW + column, side.numbers + (exists ? at : 0),
                                exists);
    }
}

typedef unsigned int Pair[2];

// Loads 16 x 16 numbers, from row `outer` and number `inner` of the axis on: four matrices, first
// along the inner axis if `is_right`, else along the outer one.
template <bool is_transposed, bool is_right>
DEVICE void load_square(Pair& near, Pair& far, const Bits* matrix, int outer, int inner) {
    int thread = threadIdx.x % 32, low = thread / 8 % 2 * 8, high = thread / 16 * 8;
    outer += is_right ? high : low;
    inner += is_right ? low : high;
    if (is_transposed)
        load_transposed(near, far, matrix + (inner + thread % 8) * ROW + outer);
    else
        load_matrices(near, far, matrix + (outer + thread % 8) * ROW + inner);
}

DEVICE unsigned int& pair_at(void* array, long long index) {
    return *(unsigned int*)((Bits*)array + index);
}

DEVICE void write_results(const ProductParams& p, int row, int column, float x, float y) {
    if (row >= p.n_rows || column >= p.n_columns)
        return;
    long long at = (long long)row * p.result_stride + column;
    if (p.bias) {
        unsigned int bias = pair_at((void*)p.bias, column);
        x += low_half(bias);
        y += high_half(bias);
    }
    if (p.addend) {
        unsigned int addend = pair_at((void*)p.addend, at);
        x += low_half(addend);
        y += high_half(addend);
    }
    pair_at(p.result, at) = p.has_relu ? pack_relu(x, y) : pack_bfloat16(x, y);
}

template <bool is_right_transposed>
DEVICE void multiply(const ProductParams& p) {
    Side left = {(const Bits*)p.left, p.left_stride, (int)blockIdx.y * TILE, p.n_rows};
    Side right = {(const Bits*)p.right, p.right_stride, (int)blockIdx.x * TILE, p.n_columns};
    int n_steps = (p.n_inner + TILE - 1) / TILE;
    auto matrix = [&](int step, int side) {
        return (Bits*)shared_memory + (2 * (step & 1) + side) * MATRIX;
    };
    auto begin = [&](int step) {
        if (step < n_steps) {
            begin_matrix<false>(matrix(step, 0), left, step * TILE, p.n_inner);
            begin_matrix<is_right_transposed>(matrix(step, 1), right, step * TILE, p.n_inner);
        }
        end_group();
    };
    int warp = threadIdx.x / 32, g = threadIdx.x % 32 / 4, q = threadIdx.x % 4;
    int row = warp / 2 * WARP_TILE, column = warp % 2 * WARP_TILE;
    float sums[2][4][4] = {};
    begin(0);
    for (int step = 0; step < n_steps; step++) {
        begin(step + 1);
        wait_for_copies<1>();
        __syncthreads();
#pragma unroll
        for (int k = 0; k < TILE; k += 16) {
            unsigned int rows[2][4], columns[4][2];
            for (int i = 0; i < 2; i++)
                load_square<false, false>((Pair&)rows[i][0], (Pair&)rows[i][2], matrix(step, 0),
                                          row + 16 * i, k);
            for (int j = 0; j < 4; j += 2)
                load_square<is_right_transposed, true>(columns[j], columns[j + 1], matrix(step, 1),
                                                       column + 8 * j, k);
            for (int i = 0; i < 2; i++)
                for (int j = 0; j < 4; j++)
                    multiply_add(sums[i][j], rows[i], columns[j][0], columns[j][1]);
        }
        __syncthreads();
    }
    row += left.first + g;
    column += right.first + 2 * q;
#pragma unroll
    for (int i = 0; i < 2; i++)
        for (int j = 0; j < 4; j++) {
            const float (&x)[4] = sums[i][j];
            write_results(p, row + 16 * i, column + 8 * j, x[0], x[1]);
            write_results(p, row + 16 * i + 8, column + 8 * j, x[2], x[3]);
        }
}

// Of a layer: inputs, and weights (N, K).
INSTANCE(__launch_bounds__(128) product_of_layer, ProductParams, multiply<false>)
// Of the inputs' gradient: that of the outputs, and weights (K, N).
INSTANCE(__launch_bounds__(128) product_of_inputs, ProductParams, multiply<true>)
