// One thread per lane.
#include "common/backend.h"
#include "common/dependent_launch.h"
#include "params.h"

KERNEL actions_of_live(ActionsOfLiveParams p) {
    wait_for_previous();
    int lane = blockIdx.x * blockDim.x + threadIdx.x;
    if (lane < p.n_lanes)
        p.out[lane] = p.ended[lane] ? 0 : p.actions[lane];
}
