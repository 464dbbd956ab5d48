// The threads that work on one environment together, and EACH_WARP, which is as EACH in backend.h:
// `group` is a warp on the GPU, where the launch has 32 threads for each i, and else one thread.
#pragma once
#include "common/backend.h"

// A single thread: always on the CPU, and on the GPU where each environment has one. Thread `rank`
// is one of SIZE.
struct SingleThread {
    static constexpr int SIZE = 1;
    int rank;
};

HD void sync(const SingleThread&) {}

HD unsigned int reduce_or(const SingleThread&, unsigned int bits) { return bits; }

HD int reduce_min(const SingleThread&, int x) { return x; }

HD int reduce_add(const SingleThread&, int x) { return x; }

// Calls f(i) for each i in [first, end), which the threads of a group divide, and waits for all.
template <class Group, class F>
HD void each(const Group& group, int first, int end, F f) {
    for (int i = first + group.rank; i < end; i += Group::SIZE)
        f(i);
    sync(group);
}

// A bit for each thread of a group, set where `is_set`.
HD unsigned int ballot(const SingleThread&, int is_set) { return is_set ? 1u : 0u; }

// Appends to a list what those threads of a group have that have something, in the order of their
// ranks. Returns the index of this thread's.
HD int append(const SingleThread&, int has, int& n) { return has ? n++ : -1; }

#ifdef HAS_THREADS
struct WholeWarp {
    static constexpr int SIZE = WARP;
    int rank;
};

DEVICE WholeWarp this_warp() { return {(int)threadIdx.x % WARP}; }

DEVICE void sync(const WholeWarp&) { __syncwarp(); }

DEVICE unsigned int reduce_or(const WholeWarp&, unsigned int bits) {
    return __reduce_or_sync(FULL_WARP, bits);
}

DEVICE int reduce_min(const WholeWarp&, int x) { return __reduce_min_sync(FULL_WARP, x); }

DEVICE int reduce_add(const WholeWarp&, int x) { return __reduce_add_sync(FULL_WARP, x); }

DEVICE unsigned int ballot(const WholeWarp&, int is_set) {
    return __ballot_sync(FULL_WARP, is_set);
}

DEVICE int append(const WholeWarp& group, int has, int& n) {
    unsigned int all = __ballot_sync(FULL_WARP, has);
    int at = n + COUNT_BITS(all & ((1u << group.rank) - 1u));
    n += COUNT_BITS(all);
    return has ? at : -1;
}

#define EACH_WARP(operation, Params, count, threads, ...)                  \
    KERNEL operation(Params p) {                                           \
        wait_for_previous();                                               \
        int n = count, i = (blockIdx.x * blockDim.x + threadIdx.x) / WARP; \
        WholeWarp group = this_warp();                                     \
        if (i < n)                                                         \
            __VA_ARGS__;                                                   \
    }
#else
#define EACH_WARP(operation, Params, count, threads, ...) \
    EACH(operation, Params, count, threads, {             \
        SingleThread group = {0};                         \
        __VA_ARGS__;                                      \
    })
#endif
