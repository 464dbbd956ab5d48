// The gradient of a layer before its activation (ReLU), and its sums over rows, which are the
// gradient of the bias. A warp adds up a strip of rows, in a fixed order. The sums of strips are
// added by the caller.
#include "lanes.h"
#include "params.h"

template <class T, int N>
DEVICE void bias_gradient(const BiasGradientParams& p) {
    int warp = (blockIdx.x * blockDim.x + threadIdx.x) / WARP, lane = threadIdx.x % WARP;
    int n_words = p.n_columns / N;                   // of a row
    int words = n_words < WARP ? n_words : WARP;     // that a warp handles
    int n_blocks = (n_words + words - 1) / words;    // of columns
    int n_groups = WARP / words;                     // rows that a warp handles at once
    int strip = warp / n_blocks, group = lane / words;
    int word = warp % n_blocks * words + lane % words;
    if (strip >= p.n_strips)
        return;
    bool is_active = group < n_groups && word < n_words;
    long long policy = blockIdx.y, first = policy * p.n_rows;
    int end = min((strip + 1) * p.strip, p.n_rows);
    float sums[N];
    clear(sums);
    if (is_active) {
#pragma unroll 4
        for (int row = strip * p.strip + group; row < end; row += n_groups) {
            long long at = (first + row) * p.n_columns + (long long)word * N;
            float values[N];
            read<T>(values, p.d, at);
            if (p.activated) {
                float activated[N];
                read<T>(activated, p.activated, at);
                for (int n = 0; n < N; n++)
                    values[n] = activated[n] > 0.f ? values[n] : 0.f;
                write<T>(p.d_masked, at, values);
            }
            for (int n = 0; n < N; n++)
                sums[n] += values[n];
        }
    }
    float totals[N];
    clear(totals);
    for (int other = 0; other < n_groups; other++)
        for (int n = 0; n < N; n++)
            totals[n] += __shfl_sync(~0u, sums[n], other * words + lane % words);
    if (is_active && !group) {
        float* target = p.sums + (policy * p.n_strips + strip) * p.n_columns + word * N;
        for (int n = 0; n < N; n++)
            target[n] = totals[n];
    }
}

KERNEL bias_gradient_float32(BiasGradientParams p) { bias_gradient<float, 4>(p); }
KERNEL bias_gradient_bfloat16(BiasGradientParams p) { bias_gradient<Bfloat16, 8>(p); }
