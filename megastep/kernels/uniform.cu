// One thread per lane.
#include "uniform.h"

KERNEL uniform(UniformParams p) {
    wait_for_previous();
    int lane = blockIdx.x * blockDim.x + threadIdx.x;
    if (lane < p.n_lanes)
        uniform_lane(p, lane);
}
