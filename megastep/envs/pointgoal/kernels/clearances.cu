// One thread per point.
#include "shortest_paths.h"

KERNEL clearances(ClearancesParams p) {
    wait_for_previous();
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < p.n_points)
        p.clearances[i] = nearest_wall(p, i);
}
