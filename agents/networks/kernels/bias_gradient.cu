// The gradient of a layer before its activation (ReLU), and its sums over rows, which are the
// gradient of the bias. A block adds up a strip of rows in a fixed order; the caller adds the
// strips. Blocks along y: words of columns, 32 at once, of all policies.
#include "constants.h"
#include "lanes.h"
#include "params.h"
#include "strips.h"

KERNEL BOUNDS(256) bias_gradient(BiasGradientParams p) {
    wait_for_previous();
    constexpr int N = 8;  // columns that a thread handles
    int n_words = p.n_columns / N, n_parts = (n_words + WARP - 1) / WARP;  // of a row
    int first_word = WARP * (blockIdx.y % n_parts);
    Strip strip = find_strip(blockIdx.x, min(n_words - first_word, WARP), p.n_rows);
    int word = first_word + strip.word;
    long long policy = blockIdx.y / n_parts, first = policy * p.n_rows;
    float sums[N];
    clear(sums);
    for (int start = strip.start; start < strip.end; start += AT_ONCE * strip.step) {
        float values[AT_ONCE][N], activated[AT_ONCE][N];
#pragma unroll
        for (int i = 0; i < AT_ONCE; i++) {
            int row = min(start + i * strip.step, strip.end - 1);
            long long at = (first + row) * p.n_columns + word * N;
            read<Bfloat16>(values[i], p.d, (first + row) * p.d_stride + word * N);
            if (p.activated)
                read<Bfloat16>(activated[i], p.activated, at);
        }
#pragma unroll
        for (int i = 0; i < AT_ONCE; i++) {
            int row = start + i * strip.step;
            if (row >= strip.end)
                break;
            if (p.activated) {
                for (int n = 0; n < N; n++)
                    values[i][n] = activated[i][n] <= 0.f ? 0.f : values[i][n];
                write<Bfloat16>(p.d_masked, (first + row) * p.n_columns + word * N, values[i]);
            }
            for (int n = 0; n < N; n++)
                sums[n] += values[i][n];
        }
    }
    float* target = p.sums + (policy * p.n_strips + blockIdx.x) * p.n_columns + N * first_word;
    add_up(sums, strip, target, strip.words * N);
}

// Adds up rows in a fixed order. A warp handles 32 columns of every eighth row.
KERNEL BOUNDS(256) sum_rows(SumRowsParams p) {
    wait_for_previous();
    constexpr int WARPS = STRIP_THREADS / WARP;
    __shared__ float of_warps[WARPS][WARP];
    int warp = threadIdx.x / WARP, lane = threadIdx.x % WARP, column = WARP * blockIdx.x + lane;
    const float* rows = p.rows + (long long)blockIdx.y * p.n_rows * p.n_columns;
    float sum = 0.f;
    if (column < p.n_columns)
#pragma unroll 8
        for (int row = warp; row < p.n_rows; row += WARPS)
            sum += rows[(long long)row * p.n_columns + column];
    of_warps[warp][lane] = sum;
    __syncthreads();
    if (warp || column >= p.n_columns)
        return;
    float total = 0.f;
    for (int i = 0; i < WARPS; i++)
        total += of_warps[i][lane];
    p.sums[blockIdx.y * p.n_columns + column] = total;
}
