// What only the device can see to be wrong sets a flag there, which engine.check reads: so no step
// synchronises. The flag is KINDS env + kind, one of these; 0 says that nothing is wrong. Of
// several errors any may stand, so threads need not agree on one.
#pragma once
#include "common.h"
#include "params.h"

constexpr int KINDS = 8;
constexpr int NONFINITE = 1, BAD_ACTION = 2, BAD_LAYOUT = 3, BAD_GOAL = 4;

HD void flag_error(int* error_flag, int env, int kind) { *error_flag = KINDS * env + kind; }

HD void flag_nonfinite(int* error_flag, int env, float x, float y, float angle) {
    if (!is_finite(x) || !is_finite(y) || !is_finite(angle))
        flag_error(error_flag, env, NONFINITE);
}

// The layout that an environment shows; 0 in place of one that does not exist.
HD int layout_of(const SceneryParams& s, int env, int* error_flag) {
    int layout = s.layout[env];
    if ((unsigned int)layout < (unsigned int)s.n_layouts)
        return layout;
    flag_error(error_flag, env, BAD_LAYOUT);
    return 0;
}
