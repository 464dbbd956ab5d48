// Reading and writing float32 and bfloat16 numbers, several at once.
#pragma once
#include "common/constants.h"
#include "common/half.h"

// The upper half of a float. Not cuda_bf16.h, so NVRTC needs no include folder.
struct Bfloat16 {
    unsigned short bits;
};

DEVICE float to_float(float x) { return x; }

DEVICE float to_float(Bfloat16 x) { return __uint_as_float((unsigned int)x.bits << 16); }

DEVICE void assign(float& target, float x) { target = x; }

// Of an array of a struct, float32 or float16.
template <class Array>
DEVICE float number_at(const Array& array, long long at) {
    if (!array.is_half)
        return ((const float*)array.values)[at];
    return half_value(((const unsigned short*)array.values)[at]);
}

// Rounds to nearest, ties to even. NaN is kept apart: rounding up could turn it into infinity.
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
DEVICE void assign(Bfloat16& target, float x) {
    asm("cvt.rn.bf16.f32 %0, %1;" : "=h"(target.bits) : "f"(x));
}
#else
DEVICE void assign(Bfloat16& target, float x) {
    unsigned int bits = __float_as_uint(x);
    bool is_nan = (bits & 0x7fffffffu) > 0x7f800000u;
    unsigned int rounded = bits + 0x7fffu + (bits >> 16 & 1u);
    target.bits = (unsigned short)((is_nan ? bits | 0x400000u : rounded) >> 16);
}
#endif

// Their types are those of words of so many bytes, each of which one instruction moves.
template <int N>
struct Bytes {};
__device__ unsigned short word_of(Bytes<2>);
__device__ unsigned int word_of(Bytes<4>);
__device__ uint2 word_of(Bytes<8>);
__device__ uint4 word_of(Bytes<16>);

// N neighbours in one word. Without it, the compiler moves some of them one by one.
template <class T, int N>
union Pack {
    decltype(word_of(Bytes<N * sizeof(T)>())) word;
    T values[N];
};

// Loads numbers without converting them, which would wait for the load.
template <class T, int N>
DEVICE void load(Pack<T, N>& pack, const void* base, long long index) {
    pack.word = ((const Pack<T, N>*)((const T*)base + index))->word;
}

template <class T, int N>
DEVICE void unpack(float (&values)[N], const Pack<T, N>& pack) {
    for (int n = 0; n < N; n++)
        values[n] = to_float(pack.values[n]);
}

template <class T, int N>
DEVICE void read(float (&values)[N], const void* base, long long index) {
    Pack<T, N> pack;
    load(pack, base, index);
    unpack(values, pack);
}

template <class T, int N>
DEVICE void write(void* base, long long index, const float (&values)[N]) {
    Pack<T, N> pack;
    for (int n = 0; n < N; n++)
        assign(pack.values[n], values[n]);
    ((Pack<T, N>*)((T*)base + index))->word = pack.word;
}

// Reads eight neighbours, which take two words.
DEVICE void read_eight(float (&values)[8], const float* address) {
    for (int i = 0; i < 8; i += 4) {
        float four[4];
        read<float>(four, address, i);
        for (int n = 0; n < 4; n++)
            values[i + n] = four[n];
    }
}

template <int N>
DEVICE void clear(float (&values)[N]) {
    for (int n = 0; n < N; n++)
        values[n] = 0.f;
}
