// The macros of backend.h on the GPU.
#pragma once
#include "common/constants.h"
#include "common/half.h"

#define HAS_THREADS
#define HD static __device__ __forceinline__
#define RARE static __device__ __noinline__
// Blocks that a multiprocessor should hold at once, or as many as it can. With 64 threads each, 24
// blocks leave a thread 40 of its 65,536 registers, 20 leave it 48, 18 leave it 56, 16 leave it 64.
#if __CUDA_ARCH__ == 750 || __CUDA_ARCH__ == 860 || __CUDA_ARCH__ == 870
#define MAX_BLOCKS 16
#elif __CUDA_ARCH__ == 890 || __CUDA_ARCH__ >= 1200
#define MAX_BLOCKS 24
#else
#define MAX_BLOCKS 32
#endif
#define BOUNDS(n_blocks) __launch_bounds__(BLOCK, (n_blocks) < MAX_BLOCKS ? (n_blocks) : MAX_BLOCKS)
#define ALIGNED __align__(16)
#define SQRT(x) sqrtf(x)
#define CEIL(x) ceilf(x)
#define FLOOR(x) floorf(x)
#define RINT(x) rintf(x)
#define ABS(x) fabsf(x)
#define TO_INT(x) ((int)(x))
#define RECIPROCAL(x) reciprocal(x)
#define LOAD(address) load(address)
#define PREFETCH(address) asm volatile("prefetch.global.L1 [%0];" ::"l"(address))
#define OR_BITS(word, bits) atomicOr(word, bits)
#define ADD(word, number) atomicAdd(word, number)
#define COUNT_BITS(word) __popc(word)
#define HALF_BITS(x) half_bits(x)
#define HALF_VALUE(bits) half_value(bits)
#define SIMD_OR(word)
#define SIMD_STEPS 1
#define NAN_VALUE __int_as_float(0x7fc00000)
#define INF_VALUE __int_as_float(0x7f800000)

constexpr unsigned int FULL_WARP = ~0u;

// The hardware's approximation and one Newton step with fused multiply-adds. IEEE division does the
// same, then handles overflow and subnormals.
DEVICE float reciprocal(float x) {
    float r;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return __fmaf_rn(r, __fmaf_rn(-x, r, 1.f), r);
}

// Reads 16 bytes at once. No `__ldg`: see dependent_launch.h.
template <class T>
DEVICE T load(const T* address) {
    float4 bits = *(const float4*)address;
    return *(T*)&bits;
}

DEVICE unsigned short half_bits(float x) {
    unsigned short bits;
    asm("cvt.rn.f16.f32 %0, %1;" : "=h"(bits) : "f"(x));
    return bits;
}
