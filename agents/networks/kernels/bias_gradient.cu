// The gradient of a layer before its activation (ReLU), and its sums over rows, which are the
// gradient of the bias. A block adds up a strip of rows in a fixed order; the caller adds the
// strips. Blocks along y: words of columns, 32 at once.
#include "strips.h"

KERNEL __launch_bounds__(256) bias_gradient(BiasGradientParams p) {
    wait_for_previous();
    constexpr int N = 8;                                            // columns that a thread handles
    int n_words = p.n_columns / N, first_word = WARP * blockIdx.y;  // of a row
    Strip strip = find_strip(blockIdx.x, min(n_words - first_word, WARP), p.n_rows);
    int word = first_word + strip.word;
    float sums[N];
    clear(sums);
    float values[AT_ONCE][N], activated[AT_ONCE][N];
    auto load = [&](int i, long long row) {
        read<Bfloat16>(values[i], p.d, row * p.d_stride + word * N);
        if (p.activated)
            read<Bfloat16>(activated[i], p.activated, row * p.n_columns + word * N);
    };
    for_rows(strip, load, [&](int i, long long row) {
        if (p.activated) {
            for (int n = 0; n < N; n++)
                values[i][n] = activated[i][n] <= 0.f ? 0.f : values[i][n];
            write<Bfloat16>(p.d_masked, row * p.n_columns + word * N, values[i]);
        }
        for (int n = 0; n < N; n++)
            sums[n] += values[i][n];
    });
    float* target = p.sums + blockIdx.x * (long long)p.n_columns + N * first_word;
    add_up(sums, strip, target, strip.words * N);
}

// Adds up rows in a fixed order. A warp handles 32 columns of every eighth row.
KERNEL __launch_bounds__(256) sum_rows(SumRowsParams p) {
    wait_for_previous();
    constexpr int WARPS = STRIP_THREADS / WARP;
    __shared__ float of_warps[WARPS][WARP];
    int warp = threadIdx.x / WARP, lane = threadIdx.x % WARP, column = WARP * blockIdx.x + lane;
    float sum = 0.f;
    if (column < p.n_columns)
#pragma unroll 8
        for (int row = warp; row < p.n_rows; row += WARPS)
            sum += p.rows[(long long)row * p.n_columns + column];
    of_warps[warp][lane] = sum;
    __syncthreads();
    if (warp || column >= p.n_columns)
        return;
    float total = 0.f;
    for (int i = 0; i < WARPS; i++)
        total += of_warps[i][lane];
    p.sums[column] = total;
}
