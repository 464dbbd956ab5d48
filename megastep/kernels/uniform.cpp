// A loop over lanes.
#include "uniform.h"

KERNEL uniform(const UniformParams& p) {
#pragma omp parallel for schedule(static) num_threads(p.n_threads)
    for (int lane = 0; lane < p.n_lanes; lane++)
        uniform_lane(p, lane);
}
