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
    bool is_ready = *p.n_available > 0 && *p.n_added >= p.first_rollouts;
    double largest = 0.;
    for (int i = threadIdx.x; i < p.n; i += blockDim.x) {
        double old = p.tree.levels[0].sums[p.index[i]], value = (double)p.errors[i];
        value = pow(value < (double)p.smallest ? (double)p.smallest : value, (double)p.alpha);
        bool is_set = is_ready && old > 0. && isfinite(value);  // NaN stays, and is not
        p.values[i] = is_set ? value : old;
        largest = is_set ? fmax(largest, value) : largest;
    }
    largest = largest_of_block<SET_THREADS>(largest);
    if (!threadIdx.x && largest > 0.)
        *p.new_priority = largest;
    set_values(p.tree, p.index, p.values, p.n);
}
