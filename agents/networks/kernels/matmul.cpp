// A matrix product: out = a b, with a bias and a ReLU. A thread takes rows of the result. Sums stay
// in registers over a block of b, which fits the first cache. Each number is the same sum in the
// same order, whatever the number of rows and threads.
#include <algorithm>
#include <memory>

#include "params.h"
#include "vector.h"

// A tile of sums, and what they are added to, fit 32 registers with AVX-512 and 16 without.
constexpr int WIDE = SIZE == 16 ? 4 : 2;       // vectors of a tile
constexpr int TILE_ROWS = SIZE == 16 ? 4 : 6;  // rows of a tile
constexpr int PANEL = WIDE * SIZE;             // columns of a block of b
constexpr int DEPTH = 8192 / PANEL;            // rows of such a block, at most: 32 kB

// Waking a sleeping thread takes 50 us; 2^25 multiples take a thread 300 us.
static int threads_of(const MatmulParams& p) {
    return (long long)p.n_rows * p.n_columns * p.depth < 1 << 25 ? 1 : p.n_threads;
}

// The first n floats at an address, then zeros.
static inline Vector load_some(const float* address, int n) {
    if (n >= SIZE)
        return load(address);
    Vector x = {};
    for (int i = 0; i < n; i++)
        x[i] = address[i];
    return x;
}

static inline void store_some(float* address, Vector x, int n) {
    if (n >= SIZE)
        return store(address, x);
    for (int i = 0; i < n; i++)
        address[i] = x[i];
}

// Copies rows [first, end) of b from a column on: n columns, then zeros up to PANEL.
static void pack(const MatmulParams& p, int first, int end, int column, int n, float* packed) {
    for (int k = first; k < end; k++, packed += PANEL) {
        const float* row = p.b + (long long)k * p.b_row + (long long)column * p.b_column;
        if (p.b_column == 1)
            std::copy(row, row + n, packed);
        else
            for (int i = 0; i < n; i++)
                packed[i] = row[(long long)i * p.b_column];
        std::fill(packed + n, packed + PANEL, 0.f);
    }
}

// Adds rows [first, end) of b to N rows of M vectors of the result, of which n columns exist.
template <int N, int M>
static void tile(const MatmulParams& p, const float* packed, int first, int end, int row,
                 int column, int n) {
    Vector sums[N][M] = {};
    const float* a = p.a + (long long)row * p.a_row + (long long)first * p.a_column;
    for (int k = first; k < end; k++, packed += PANEL, a += p.a_column) {
        Vector b[M];
#pragma GCC unroll 4
        for (int m = 0; m < M; m++) {
            b[m] = load(packed + m * SIZE);
            IN_REGISTER(b[m]);
        }
#pragma GCC unroll 8
        for (int i = 0; i < N; i++)
#pragma GCC unroll 4
            for (int m = 0; m < M; m++)
                sums[i][m] = multiply_add(a[(long long)i * p.a_row], b[m], sums[i][m]);
    }
    bool is_first = first == 0, has_relu = p.has_relu && end == p.depth;
    const float* bias = is_first && p.bias ? p.bias + column : nullptr;
    float* out = p.out + (long long)row * p.out_row + column;
#pragma GCC unroll 4
    for (int m = 0; m < M; m++) {
        int n_left = n - m * SIZE;
        Vector offset = bias ? load_some(bias + m * SIZE, n_left) : Vector{};
#pragma GCC unroll 8
        for (int i = 0; i < N; i++) {
            float* target = out + (long long)i * p.out_row + m * SIZE;
            Vector sum = sums[i][m] + offset;
            if (!is_first || p.adds)
                sum += load_some(target, n_left);
            if (has_relu)
                sum = sum < 0.f ? Vector{} : sum;  // NaN stays NaN
            store_some(target, sum, n_left);
        }
    }
}

template <int M>
static void tiles(const MatmulParams& p, const float* packed, int first, int end, int column, int n,
                  int row, int last_row) {
    for (; row + TILE_ROWS <= last_row; row += TILE_ROWS)
        tile<TILE_ROWS, M>(p, packed, first, end, row, column, n);
    for (; row < last_row; row++)
        tile<1, M>(p, packed, first, end, row, column, n);
}

static void multiply(const MatmulParams& p, int row, int last_row, float* packed) {
    int n_blocks = (p.depth + DEPTH - 1) / DEPTH;
    for (int column = 0; column < p.n_columns; column += PANEL) {
        int n = mini(PANEL, p.n_columns - column);
        for (int block = 0; block < n_blocks; block++) {
            int first = (long long)p.depth * block / n_blocks;
            int end = (long long)p.depth * (block + 1) / n_blocks;
            pack(p, first, end, column, n, packed);
            if (n > SIZE)
                tiles<WIDE>(p, packed, first, end, column, n, row, last_row);
            else
                tiles<1>(p, packed, first, end, column, n, row, last_row);
        }
    }
}

KERNEL matmul(const MatmulParams& p) {
    on_threads(p.n_rows, TILE_ROWS, threads_of(p), [&](int first, int end) {
        std::unique_ptr<Vector[]> packed(new Vector[DEPTH * WIDE]);
        multiply(p, first, end, (float*)packed.get());
    });
}
