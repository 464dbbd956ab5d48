// Looks for numbers of a rollout that are NaN, infinite or too large.
#include "common/numbers.h"
#include "params.h"

// Whether a word has a bad number: two float16 or one float32. A float16 is bad if all bits of its
// exponent are set, because its largest finite number is below any limit.
DEVICE bool is_bad(unsigned int word, bool is_half, unsigned int limit) {
    if (is_half)
        return ((word & 0x7c007c00u) + 0x04000400u) & 0x80008000u;
    return (word & 0x7fffffffu) > limit;  // NaN is above infinity
}

// Keeps the row of a number if it is its lane's first.
DEVICE void keep(const FindBadParams& p, int of_tensor, long long at) {
    const CheckedTensorParams& tensor = p.tensors[of_tensor];
    long long source_row = at / tensor.n_features;
    int lane = source_row % p.n_lanes, t = source_row / p.n_lanes + p.n_steps - tensor.n_steps;
    atomicMin(p.first_rows + lane, t * p.n_tensors + of_tensor);  // the same whatever the order
}

// A thread reads CHECKED_WORDS words of 16 bytes, a block neighbouring ones of one tensor.
KERNEL __launch_bounds__(256) find_bad(FindBadParams p) {
    wait_for_previous();
    int i = 0;
    while (i + 1 < p.n_tensors && p.tensors[i + 1].first_block <= blockIdx.x)
        i++;
    const CheckedTensorParams& tensor = p.tensors[i];
    bool is_half = tensor.is_half;
    int per_word = is_half ? 8 : 4;
    unsigned int limit = __float_as_uint(p.limit);
    long long first_word =
        (long long)(blockIdx.x - tensor.first_block) * (CHECKED_THREADS * CHECKED_WORDS);
    long long n_numbers = (long long)tensor.n_steps * p.n_lanes * tensor.n_features;
    long long n_words = n_numbers / per_word;
    uint4 words[CHECKED_WORDS];
    for (int n = 0; n < CHECKED_WORDS; n++) {
        long long at = first_word + n * CHECKED_THREADS + threadIdx.x;
        words[n] = at < n_words ? ((const uint4*)tensor.values)[at] : make_uint4(0, 0, 0, 0);
    }
#pragma unroll
    for (int n = 0; n < CHECKED_WORDS; n++) {
        bool found = is_bad(words[n].x, is_half, limit) || is_bad(words[n].y, is_half, limit) ||
                     is_bad(words[n].z, is_half, limit) || is_bad(words[n].w, is_half, limit);
        long long first = (first_word + n * CHECKED_THREADS + threadIdx.x) * per_word;
        bool is_end = first == n_words * per_word;  // the numbers after the last whole word
        if (!found && !is_end)
            continue;
        for (long long at = first; at < min(first + per_word, n_numbers); at++)
            if (!(fabsf(number_at(tensor, at)) <= p.limit))
                keep(p, i, at);
    }
}

// The largest magnitude of a row of a tensor, or NaN; of float16, of which one is infinite or NaN,
// that of their sum.
DEVICE float size_of(const CheckedTensorParams& tensor, long long row) {
    float size = 0.f;
    for (int i = 0; i < tensor.n_features; i++) {
        float value = number_at(tensor, row * tensor.n_features + i);
        if (tensor.is_half)
            size += value;
        else
            size = size > fabsf(value) || isnan(size) ? size : fabsf(value);
    }
    return fabsf(size);
}

// One block. Counts the rollout, and keeps its first bad number, that of the smallest row and lane,
// unless an earlier rollout's is still there.
KERNEL __launch_bounds__(1024) record(RecordParams p) {
    wait_for_previous();
    __shared__ unsigned long long first;
    __shared__ int n_bad;
    if (!threadIdx.x) {
        first = ~0ull;
        n_bad = 0;
    }
    __syncthreads();
    int n_rows = p.n_steps * p.n_tensors;
    for (int lane = threadIdx.x; lane < p.n_lanes; lane += RECORD_THREADS)
        if (p.first_rows[lane] < n_rows) {  // there are few
            atomicAdd(&n_bad, 1);
            atomicMin(&first, (unsigned long long)p.first_rows[lane] * p.n_lanes + lane);
        }
    __syncthreads();
    if (threadIdx.x)
        return;
    *p.is_finite = !n_bad;
    p.record[0] += 1.;
    if (!n_bad || p.record[2] > 0.)
        return;
    int row = first / p.n_lanes, lane = first % p.n_lanes;
    const CheckedTensorParams& tensor = p.tensors[row % p.n_tensors];
    long long t = row / p.n_tensors - (p.n_steps - tensor.n_steps);
    float size = size_of(tensor, t * p.n_lanes + lane);
    p.record[2] = p.record[0];
    p.record[3] = n_bad;
    p.record[4] = (double)first;
    p.record[5] = isnan(size) ? -1. : isinf(size) ? 1.7976931348623157e308 : (double)size;
}
