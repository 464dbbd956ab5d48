// The threads of a warp as a group that works on one environment, see common/line_of_sight.h.
#pragma once
#include "common/backend.h"
#include "common/constants.h"

struct WholeWarp {
    static constexpr int SIZE = WARP;
    int rank;
};

DEVICE void sync(const WholeWarp&) { __syncwarp(); }

DEVICE unsigned int reduce_or(const WholeWarp&, unsigned int bits) {
    return __reduce_or_sync(FULL_WARP, bits);
}
