// The sum tree on a GPU: a block of 32 children is what a warp reads at once.
#include "common/sums.h"
#include "params.h"

// The number of the child of a block whose part of the total holds `rest`, from which the children
// before it are subtracted. Of the whole warp, each thread with its child's sum.
DEVICE int find_child(double sum, double& rest) {
    int lane = threadIdx.x % WARP;
    double sums = sum;  // up to this child
    for (int step = 1; step < WARP; step *= 2) {
        double before = __shfl_up_sync(~0u, sums, step);
        sums += lane < step ? 0. : before;
    }
    unsigned int positive = __ballot_sync(~0u, sum > 0.);
    unsigned int beyond = __ballot_sync(~0u, sum > 0. && sums > rest);
    // if rounding left a rest beyond the total, the last child that can be drawn
    int child = beyond ? __ffs(beyond) - 1 : positive ? 31 - __clz(positive) : 0;
    rest -= __shfl_sync(~0u, sums - sum, child);
    return child;
}

// Replaces priorities at index (n). Of several values for one index, the largest stays. For one
// block of threads; values (n) were written by these threads, each those that it handles here.
DEVICE void set_values(const SumTreeParams& tree, const long long* index, const double* values,
                       int n) {
    double* priorities = tree.levels[0].sums;
    for (int i = threadIdx.x; i < n; i += blockDim.x)
        priorities[index[i]] = 0.;
    __syncthreads();
    for (int i = threadIdx.x; i < n; i += blockDim.x)  // positive numbers compare as integers
        atomicMax((long long*)priorities + index[i], __double_as_longlong(values[i]));
    __syncthreads();
    for (int level = 1, shift = 5; level < tree.n_levels; level++, shift += 5) {
        const double* lower = tree.levels[level - 1].sums;
        double* upper = tree.levels[level].sums;
        for (int i = threadIdx.x; i < n; i += blockDim.x) {
            long long block = index[i] >> shift;
            const double2* children = (const double2*)(lower + block * WARP);
            double sum = 0.;
#pragma unroll
            for (int k = 0; k < WARP / 2; k++) {
                double2 pair = __ldcg(children + k);  // from where the atomics are
                sum += pair.x;
                sum += pair.y;
            }
            upper[block] = sum;  // those of one block write the same number
        }
        __syncthreads();
    }
}

// Draws indices in proportion to their priorities, one warp per index, from the highest level down.
KERNEL sample_tree(SampleTreeParams p) {
    wait_for_previous();
    int sample = (blockIdx.x * blockDim.x + threadIdx.x) / WARP, lane = threadIdx.x % WARP;
    if (sample >= p.n_samples)
        return;
    long long index = 0;
    double rest = 0., total = 0.;
    for (int level = p.tree.n_levels - 1; level >= 0; level--) {
        double sum = p.tree.levels[level].sums[index * WARP + lane];
        if (level == p.tree.n_levels - 1) {
            total = sum_of_threads(sum);
            rest = (p.fractions[sample] + sample) / p.n_samples * total;
        }
        int child = find_child(sum, rest);
        if (!level && lane == child) {
            p.index[sample] = index * WARP + child;
            p.probability[sample] = sum / fmax(total, 2.2250738585072014e-308);
        }
        index = index * WARP + child;
    }
}

// Changes priorities and the sums above them, in one block: there are a few thousand, and each
// level waits for the one below.
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
