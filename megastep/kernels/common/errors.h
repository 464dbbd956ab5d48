// Errors that only the device can see, such as a NaN position. A kernel sets a flag and continues;
// engine.check reads the flag later, so no step synchronises host and device. If several errors
// occur, any one of them is kept.
#pragma once
#include "common/constants.h"
#include "common/math.h"

HD void flag_error(int* error_flag, int index, int kind) {
    *error_flag = ERROR_KINDS * index + kind;
}

HD void flag_nonfinite(int* error_flag, int env, float x, float y, float angle) {
    if (!is_finite(x) || !is_finite(y) || !is_finite(angle))
        flag_error(error_flag, env, NONFINITE);
}
