// How the kernels of recurrent cores are divided among threads: one thread per lane and n_units
// neighbouring units.
#pragma once
#include "common/constants.h"
#include "common/dependent_launch.h"
#include "number.h"

#define BOUNDS(n_threads) __launch_bounds__(n_threads)

// A thread's lane, and the offsets of its units in an array (B, W) and in the first gate of an
// array (B, gates W).
struct UnitIndex {
    int lane;
    long long unit, gate;
};

template <int N_GATES, class Params>
DEVICE bool find_index(const Params& p, UnitIndex& index) {
    unsigned int thread = blockIdx.x * blockDim.x + threadIdx.x;
    unsigned int threads_per_lane = p.width / p.n_units;
    unsigned int lane = thread / threads_per_lane;
    long long first = thread % threads_per_lane * p.n_units, row = (long long)lane * p.width;
    index = {(int)lane, row + first, N_GATES * row + first};
    return lane < (unsigned int)p.n_lanes;
}

template <int N>
DEVICE void clear(float (&values)[N]) {
    for (int n = 0; n < N; n++)
        values[n] = 0.f;
}

// Runs an operation on numbers of type T, for the lane and units of this thread.
template <class Operation, class T, class Params>
DEVICE void run(const Params& p) {
    UnitIndex index;
    if (!find_index<Operation::N_GATES>(p, index))
        return;
    if (p.n_units == 4)
        Operation::template run<T, 4>(p, index);
    else
        Operation::template run<T, 1>(p, index);
}
