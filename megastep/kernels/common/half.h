#pragma once
#include "common/dependent_launch.h"

// fp16 without cuda_fp16.h: NVRTC then needs no include folder.
DEVICE float half_value(unsigned short bits) {
    float x;
    asm("cvt.f32.f16 %0, %1;" : "=f"(x) : "h"(bits));
    return x;
}
