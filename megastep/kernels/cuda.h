// How the GPU spells what math.h and scene.h leave to the backend.
#define HD static __device__ __forceinline__
#define DEVICE static __device__ __forceinline__
#define KERNEL extern "C" __global__ void
#define ALIGNED __align__(16)
#define BOUNDS __launch_bounds__(64, 24)       // threads a block, as compile.py launches them; blocks a multiprocessor, which leaves a thread 40 registers
#define SQRT(x) sqrtf(x)
#define CEIL(x) ceilf(x)
#define FLOOR(x) floorf(x)
#define RINT(x) rintf(x)
// The processor's approximation, and one step of Newton with fused multiply-adds, is how IEEE division rounds correctly, less the tests of what floats cannot hold.
DEVICE float reciprocal(float x) { float r; asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x)); return __fmaf_rn(r, __fmaf_rn(-x, r, 1.f), r); }
#define RECIPROCAL(x) reciprocal(x)
template <class T> DEVICE T load(const T* at) { float4 bits = __ldg((const float4*)at); return *(T*)&bits; }
#define LOAD(at) load(at)
#define NAN_VALUE __int_as_float(0x7fc00000)
#define INFINITE __int_as_float(0x7f800000)
#define OR_BITS(word, bits) atomicOr(word, bits)
DEVICE unsigned short half_bits(float x) { unsigned short bits; asm("cvt.rn.f16.f32 %0, %1;" : "=h"(bits) : "f"(x)); return bits; }
#define HALF_BITS(x) half_bits(x)
