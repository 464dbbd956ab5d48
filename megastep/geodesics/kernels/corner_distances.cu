// One block per home: the Bellman-Ford algorithm, a thread per corner and goal. See
// corner_distances.cpp.
#include "shortest_paths.h"

KERNEL corner_distances(CornerDistancesParams p) {
    wait_for_previous();
    int home = blockIdx.x;
    int first = MAX_GOALS * p.homes.corner_starts[home];
    int end = MAX_GOALS * p.homes.corner_starts[home + 1];
    volatile float* distances = p.distances;  // other threads of the block write, too
    for (int i = first + threadIdx.x; i < end; i += blockDim.x) {
        int corner = i / MAX_GOALS, goal = i % MAX_GOALS;
        distances[i] = goal < p.n_goals ? straight_to_goal(p, home, corner, goal) : INF_VALUE;
    }
    __syncthreads();
    for (int changed = 1; changed;) {
        changed = 0;
        for (int i = first + threadIdx.x; i < end; i += blockDim.x) {
            int corner = i / MAX_GOALS, goal = i % MAX_GOALS;
            float before = distances[i], best = before;
            for (int link = p.starts[corner]; link < p.starts[corner + 1]; link++)
                best = minf(best, distances[MAX_GOALS * p.targets[link] + goal] + p.metres[link]);
            if (best < before) {
                distances[i] = best;
                changed = 1;
            }
        }
        changed = __syncthreads_or(changed);
    }
}
