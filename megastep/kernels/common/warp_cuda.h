// The threads of a warp as a group that works on one environment, see common/line_of_sight.h.
#pragma once
#include "common/backend.h"

struct WholeWarp {
    static constexpr int SIZE = WARP;
    int rank;
};

DEVICE void sync(const WholeWarp&) { __syncwarp(); }

DEVICE unsigned int reduce_or(const WholeWarp&, unsigned int bits) {
    return __reduce_or_sync(FULL_WARP, bits);
}

// As of one thread, see physics_bodies.h.
DEVICE unsigned int ballot(const WholeWarp&, int is_set) {
    return __ballot_sync(FULL_WARP, is_set);
}

DEVICE int append(const WholeWarp& group, int has, int& n) {
    unsigned int all = __ballot_sync(FULL_WARP, has);
    int at = n + COUNT_BITS(all & ((1u << group.rank) - 1u));
    n += COUNT_BITS(all);
    return has ? at : -1;
}
