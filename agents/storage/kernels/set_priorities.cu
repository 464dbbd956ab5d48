// Changes priorities in a sum tree and the sums above them, in one block: there are a few thousand,
// and each level waits for the one below.
#include "sum_tree.h"

KERNEL set_tree(SetTreeParams p) {
    wait_for_previous();
    set_values(p.tree, p.index, p.values, p.n);
}

// `ReplayBuffer.set_priorities`
KERNEL set_priorities(SetPrioritiesParams p) {
    wait_for_previous();
    __shared__ double of_warps[SET_THREADS / WARP];
    bool is_ready = *p.n_available > 0 && *p.n_added >= p.first_rollouts;
    double largest = 0.;
    for (int i = threadIdx.x; i < p.n; i += blockDim.x) {
        double old = p.tree.levels[0].sums[p.index[i]], value = (double)p.errors[i];
        value = pow(value < (double)p.smallest ? (double)p.smallest : value, (double)p.alpha);
        bool is_set = is_ready && old > 0. && isfinite(value);  // NaN stays, and is not
        p.values[i] = is_set ? value : old;
        largest = is_set ? fmax(largest, value) : largest;
    }
    for (int mask = WARP / 2; mask; mask /= 2)
        largest = fmax(largest, __shfl_xor_sync(~0u, largest, mask));
    if (threadIdx.x % WARP == 0)
        of_warps[threadIdx.x / WARP] = largest;
    __syncthreads();
    if (!threadIdx.x) {
        for (int warp = 1; warp < SET_THREADS / WARP; warp++)
            largest = fmax(largest, of_warps[warp]);
        if (largest > 0.)
            *p.new_priority = largest;
    }
    set_values(p.tree, p.index, p.values, p.n);
}
