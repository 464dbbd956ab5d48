// Reading float16 numbers. Not cuda_fp16.h, so NVRTC needs no include folder.
#pragma once
#include "number.h"

DEVICE float half_value(unsigned int bits) {
    float x;
    asm("cvt.f32.f16 %0, %1;" : "=f"(x) : "h"((unsigned short)bits));
    return x;
}
