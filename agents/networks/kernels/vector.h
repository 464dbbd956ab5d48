// Vectors of floats on the CPU, and the gates' activations.
#pragma once
#include "common/math.h"

#ifdef __FMA__
#include <immintrin.h>
#endif

#ifdef __AVX512F__
constexpr int SIZE = 16;  // floats of a vector
constexpr int ROWS = 4;   // lanes of a tile of a matrix product, whose sums stay in registers
// Keeps the compiler from reading a vector again for each product.
#define IN_REGISTER(vector) asm("" : "+v"(vector))
#else
constexpr int SIZE = 8;
constexpr int ROWS = 2;
#define IN_REGISTER(vector)
#endif

typedef float Vector __attribute__((vector_size(4 * SIZE)));
typedef int IntVector __attribute__((vector_size(4 * SIZE)));
typedef float AnyVector __attribute__((vector_size(4 * SIZE), aligned(4), may_alias));

static inline Vector load(const float* address) { return *(const AnyVector*)address; }

static inline void store(float* address, Vector x) { *(AnyVector*)address = x; }

static inline Vector all(float x) { return Vector{} + x; }

// a x + y, rounded once where the processor can. Left to the compiler, sums of few rows may be
// rounded twice (GCC does on AMD's Zen), so their bits would depend on the number of rows.
static inline Vector multiply_add(float a, Vector x, Vector y) {
#if defined(__AVX512F__)
    return (Vector)_mm512_fmadd_ps(_mm512_set1_ps(a), (__m512)x, (__m512)y);
#elif defined(__FMA__)
    return (Vector)_mm256_fmadd_ps(_mm256_set1_ps(a), (__m256)x, (__m256)y);
#else
    return a * x + y;
#endif
}

// The polynomial is that of Cephes. Relative error below 2e-7; NaN stays NaN.
static inline Vector exp_of(Vector x) {
    x = x < -87.f ? all(-87.f) : x;
    x = x > 87.f ? all(87.f) : x;
    // adding 1.5 * 2^23 rounds to an integer, which is then in the lowest bits
    Vector shifted = x * 1.44269504f + 12582912.f;
    Vector n = shifted - 12582912.f;
    Vector r = x - n * 0.693359375f + n * 2.12194440e-4f;
    Vector y = r * 1.9875691500e-4f + 1.3981999507e-3f;
    y = y * r + 8.3334519073e-3f;
    y = y * r + 4.1665795894e-2f;
    y = y * r + 1.6666665459e-1f;
    y = y * r + 5.0000001201e-1f;
    y = y * (r * r) + r + 1.f;
    return y * (Vector)(((IntVector)shifted << 23) + 0x3f800000);
}

// Absolute errors below 2e-7.
static inline Vector sigmoid(Vector x) { return 1.f / (1.f + exp_of(-x)); }

static inline Vector tanh_of(Vector x) { return 1.f - 2.f / (1.f + exp_of(2.f * x)); }

// Calls f with the rows [first, end) of each thread, whole tiles but for the last.
template <class F>
static void on_threads(int n_rows, int tile_rows, int n_threads, F f) {
    int n_tiles = (n_rows + tile_rows - 1) / tile_rows;
#pragma omp parallel for schedule(static) num_threads(n_threads)
    for (int i = 0; i < n_threads; i++) {
        int first = tile_rows * (int)((long long)n_tiles * i / n_threads);
        f(first, mini(tile_rows * (int)((long long)n_tiles * (i + 1) / n_threads), n_rows));
    }
}
