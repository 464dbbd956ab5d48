// A loop over homes. In each, the Bellman-Ford algorithm for all goals at once. Distances only fall
// until nothing changes, and end at the same bits in any order, as sums of floats are monotone.
#include "shortest_paths.h"

KERNEL corner_distances(const CornerDistancesParams& p) {
    const HomesParams& homes = p.homes;
#pragma omp parallel for schedule(dynamic, 1) num_threads(homes.n_threads)
    for (int home = 0; home < homes.n_homes; home++) {
        int first = homes.corner_starts[home], end = homes.corner_starts[home + 1];
        for (int corner = first; corner < end; corner++)
            for (int goal = 0; goal < MAX_GOALS; goal++)
                p.distances[(long long)MAX_GOALS * corner + goal] =
                    goal < p.n_goals ? straight_to_goal(p, home, corner, goal) : INF_VALUE;
        for (int changed = 1; changed;) {
            changed = 0;
            for (int corner = first; corner < end; corner++) {
                float* distances = p.distances + (long long)MAX_GOALS * corner;
                float best[MAX_GOALS];
                for (int goal = 0; goal < MAX_GOALS; goal++)
                    best[goal] = distances[goal];
                for (int link = p.starts[corner]; link < p.starts[corner + 1]; link++) {
                    const float* from = p.distances + (long long)MAX_GOALS * p.targets[link];
                    for (int goal = 0; goal < MAX_GOALS; goal++)
                        best[goal] = minf(best[goal], from[goal] + p.metres[link]);
                }
                for (int goal = 0; goal < MAX_GOALS; goal++) {
                    changed |= best[goal] < distances[goal];
                    distances[goal] = best[goal];
                }
            }
        }
    }
}
