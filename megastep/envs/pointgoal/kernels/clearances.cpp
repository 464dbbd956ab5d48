// A loop over points.
#include "shortest_paths.h"

KERNEL clearances(const ClearancesParams& p) {
#pragma omp parallel for schedule(static) num_threads(p.homes.n_threads)
    for (int i = 0; i < p.n_points; i++)
        p.clearances[i] = nearest_wall(p, i);
}
