// The macros of backend.h on the CPU.
#pragma once

#define HD static inline
#ifdef __wasm__  // whose modules are to be small
#define RARE static __attribute__((noinline))
#else
#define RARE static inline
#endif
#define KERNEL extern "C" void
// A tensor may start anywhere in the CPU's memory, so 16-byte records are not aligned.
#define ALIGNED
#define SQRT(x) __builtin_sqrtf(x)
#define CEIL(x) __builtin_ceilf(x)
#define FLOOR(x) __builtin_floorf(x)
#define RINT(x) __builtin_rintf(x)
#define ABS(x) __builtin_fabsf(x)
#define TO_INT(x) to_int(x)
#define RECIPROCAL(x) (1.f / (x))
#define LOAD(address) (*(address))
#define OR_BITS(word, bits) or_bits(word, bits)
#define ADD(word, number) (*(word) += (number))
#define COUNT_BITS(word) __builtin_popcount(word)
#define HALF_BITS(x) half_bits(x)
#define HALF_VALUE(bits) half_value(bits)
#define PRAGMA(words) _Pragma(#words)
#define SIMD_OR(word) PRAGMA(omp simd reduction(| : word))
#define SIMD_STEPS 64
#define NAN_VALUE __builtin_nanf("")
#define INF_VALUE __builtin_inff()

// Cuts a float to an int, as a GPU does. C leaves undefined what NaN and large numbers become.
static inline int to_int(float x) {
    if (x >= 2147483648.f)
        return 2147483647;
    if (x < -2147483648.f)
        return -2147483647 - 1;
    return x == x ? (int)x : 0;
}

// Sets bits of a word and returns its old value. Not atomic: one thread owns an agent's words.
static inline unsigned int or_bits(unsigned int* word, unsigned int bits) {
    unsigned int old = *word;
    *word = old | bits;
    return old;
}

static inline unsigned int float_bits(float value) {
    union {
        float value;
        unsigned int bits;
    } same = {value};
    return same.bits;
}

// Rounds to fp16, to nearest even, with integer instructions that every processor has. All cases
// are computed, so that compilers vectorise loops over it.
static inline unsigned short half_bits(float value) {
    unsigned int bits = float_bits(value);
    unsigned int sign = (bits >> 16) & 0x8000u;
    unsigned int magnitude = bits & 0x7fffffffu;
    unsigned int to_even = 0xfffu + ((magnitude >> 13) & 1u);
    unsigned int half = (magnitude - 0x38000000u + to_even) >> 13;
    // subnormal in fp16: adding 0.5 shifts and rounds it
    unsigned int subnormal = float_bits(__builtin_fabsf(value) + 0.5f) - 0x3f000000u;
    half = magnitude < 0x38800000u ? subnormal : half;
    half = magnitude >= 0x477ff000u ? 0x7c00u : half;  // more than 65504, the largest fp16 value
    half |= sign;
    // NaN: a GPU turns all of them into this one
    return (unsigned short)(magnitude > 0x7f800000u ? 0x7fffu : half);
}

static inline float half_value(unsigned short bits) {
    union {
        unsigned int bits;
        float value;
    } same = {(bits & 0x7fffu) << 13};
    same.value *= 0x1p112f;  // the difference of the exponents, for subnormals too
    if ((bits & 0x7c00u) == 0x7c00u)
        same.bits |= 0x7f800000u;
    same.bits |= (bits & 0x8000u) << 16;
    return same.value;
}
