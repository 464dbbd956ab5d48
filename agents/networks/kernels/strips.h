// How a block of STRIP_THREADS adds up columns of STRIP rows, always in the same order. A thread
// handles one word of N columns in several rows. A block handles at most 32 words at once, and a
// warp as many rows at once as it has threads for.
#pragma once
#include "common/numbers.h"
#include "params.h"

constexpr int STRIP_WARPS = STRIP_THREADS / WARP;
constexpr int AT_ONCE = 4;  // rows of a thread whose loads do not wait for each other

struct Strip {
    int words;             // of the block
    int groups;            // rows that a warp handles at once
    int word;              // of the thread
    int start, end, step;  // rows of the thread: start, start + step, ... up to end, exclusive
};

DEVICE Strip find_strip(int strip, int words, int n_rows) {
    int warp = threadIdx.x / WARP, lane = threadIdx.x % WARP;
    int groups = WARP / words, group = lane / words, first = strip * STRIP;
    int end = min(first + STRIP, n_rows);
    // the last threads of a warp may be in no group
    int start = group < groups ? first + warp * groups + group : end;
    return {words, groups, lane % words, start, end, STRIP_WARPS * groups};
}

// Calls load(i, row) for AT_ONCE rows of the thread, the last one again if there are fewer, and
// then use(i, row) for those that exist, until all were.
template <class Load, class Use>
DEVICE void for_rows(const Strip& strip, Load load, Use use) {
    for (int start = strip.start; start < strip.end; start += AT_ONCE * strip.step) {
        for (int i = 0; i < AT_ONCE; i++)
            load(i, (long long)min(start + i * strip.step, strip.end - 1));
        for (int i = 0; i < AT_ONCE; i++) {
            int row = start + i * strip.step;
            if (row >= strip.end)
                break;
            use(i, row);
        }
    }
}

// Adds up all threads' sums and writes the first n_columns. All threads of the block take part.
template <int N>
DEVICE void add_up(float (&sums)[N], const Strip& strip, float* target, int n_columns) {
    __shared__ float of_warps[STRIP_WARPS][N * WARP];
    int groups = strip.groups;
    if (groups * strip.words == WARP) {  // a power of two each
        for (int mask = WARP / 2; mask >= strip.words; mask /= 2)
            for (int n = 0; n < N; n++)
                sums[n] += __shfl_xor_sync(~0u, sums[n], mask);
        groups = 1;
    }
    __syncthreads();  // an earlier call may still be reading
    for (int n = 0; n < N; n++)
        of_warps[threadIdx.x / WARP][N * (threadIdx.x % WARP) + n] = sums[n];
    __syncthreads();
    for (int column = threadIdx.x; column < n_columns; column += STRIP_THREADS) {
        float total = 0.f;
        for (int warp = 0; warp < STRIP_WARPS; warp++)
            for (int group = 0; group < groups; group++)
                total += of_warps[warp][group * strip.words * N + column];
        target[column] = total;
    }
}
