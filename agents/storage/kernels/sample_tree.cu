// Draws indices from a sum tree in proportion to their priorities, one warp per index, from the
// highest level down.
#include "sum_tree.h"

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
