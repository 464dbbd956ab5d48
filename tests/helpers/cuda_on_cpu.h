// Lets a CUDA kernel of independent threads compile for a CPU, where its threads run one after
// another.
#include <algorithm>
#include <cmath>
#include <cstring>

#include "common/constants.h"

#define __device__
#define __global__
#define __forceinline__ inline
#define __launch_bounds__(n_threads)
#define __expf expf

using std::max;
using std::min;

struct uint2 {
    unsigned int x, y;
};
struct uint4 {
    unsigned int x, y, z, w;
};
struct Index {
    unsigned int x;
};
static Index blockIdx, threadIdx;
static const Index blockDim = {BLOCK};

static inline float __uint_as_float(unsigned int bits) {
    float x;
    memcpy(&x, &bits, 4);
    return x;
}
static inline unsigned int __float_as_uint(float x) {
    unsigned int bits;
    memcpy(&bits, &x, 4);
    return bits;
}
// As CUDA documents it: a divisor above 2^126 gives 0.
static inline float __fdividef(float x, float y) { return fabsf(y) > 0x1p126f ? x * 0.f : x / y; }

template <class Params>
void launch(void (*kernel)(Params), const Params* p, unsigned int threads) {
    unsigned int n_blocks = (threads + BLOCK - 1) / BLOCK;
    for (blockIdx.x = 0; blockIdx.x < n_blocks; blockIdx.x++)
        for (threadIdx.x = 0; threadIdx.x < BLOCK; threadIdx.x++)
            kernel(*p);
}
