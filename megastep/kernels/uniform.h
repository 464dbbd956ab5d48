// Four uniform random numbers per lane.
#pragma once
#include "common/philox.h"
#include "params.h"

HD void uniform_lane(const UniformParams& p, int lane) {
    if (!p.mask[lane])
        return;
    unsigned int draw = (unsigned int)p.counts[lane];
    Philox bits = philox((unsigned int)lane, draw, p.key0, p.key1);
    float* out = p.out + 4 * (long long)lane;
    out[0] = unit_float(bits.a);
    out[1] = unit_float(bits.b);
    out[2] = unit_float(bits.c);
    out[3] = unit_float(bits.d);
}

EACH(uniform, UniformParams, p.n_lanes, p.n_threads, uniform_lane(p, i))
