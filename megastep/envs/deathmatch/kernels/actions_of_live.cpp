// A loop over lanes.
#include "common/backend.h"
#include "params.h"

KERNEL actions_of_live(const ActionsOfLiveParams& p) {
    for (int lane = 0; lane < p.n_lanes; lane++)
        p.out[lane] = p.ended[lane] ? 0 : p.actions[lane];
}
