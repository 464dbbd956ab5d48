// What goes wrong on the device sets a flag there, which engine.check reads: no step synchronises.
#pragma once
#include "common.h"

HD void flag_nonfinite(int* error_flag, int env, float x, float y, float angle) {
    if (!is_finite(x) || !is_finite(y) || !is_finite(angle))
        *error_flag = env + 1;
}
