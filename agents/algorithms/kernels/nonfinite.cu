// Looks for numbers of a rollout that are NaN, infinite or too large.
#include "common/constants.h"
#include "constants.h"
#include "params.h"

#define KERNEL extern "C" __global__ void
#define BOUNDS(n_threads) __launch_bounds__(n_threads)

static __device__ __forceinline__ float half_value(unsigned int bits) {
    float x;
    asm("cvt.f32.f16 %0, %1;" : "=f"(x) : "h"((unsigned short)bits));
    return x;
}

static_assert(sizeof(SizesParams::tensors) == SIZES_TENSORS * sizeof(SizesTensorParams));

// The larger magnitude; NaN if one is NaN.
static __device__ __forceinline__ float larger(float size, float value) {
    value = fabsf(value);
    return size > value || isnan(size) ? size : value;
}

// A float16 beyond the limit is infinite and stays so, or becomes NaN, in a sum, which is faster
// than a maximum.
//
// Blocks along y: tensors. A tensor's rows begin at its last step: if it has one step less, the
// first row of its sizes is 0.
KERNEL sizes(SizesParams p) {
    const SizesTensorParams& tensor = p.tensors[blockIdx.y];
    bool is_shared = tensor.n_features >= SIZES_THREADS;  // a row, by several threads
    unsigned int thread = blockIdx.x * blockDim.x + threadIdx.x, n_rows = p.n_steps * p.n_lanes;
    unsigned int part = is_shared ? thread % SIZES_THREADS : 0;
    unsigned int at = is_shared ? thread / SIZES_THREADS : thread;
    if (!is_shared && at >= n_rows)
        return;
    bool exists = at < n_rows;
    at = min(at, n_rows - 1);
    int t = at / p.n_lanes, lane = at % p.n_lanes, source_t = t - (p.n_steps - tensor.n_steps);
    float size = 0.f;
    if (source_t >= 0) {
        long long first = ((long long)source_t * p.n_lanes + lane) * tensor.n_features;
        const unsigned short* halves = (const unsigned short*)tensor.values + first;
        const float* floats = (const float*)tensor.values + first;
        if (tensor.is_half && tensor.n_features % 8 == 0 && (long long)tensor.values % 16 == 0)
            for (int i = 8 * part; i < tensor.n_features; i += 8 * SIZES_THREADS) {
                uint4 words = *(const uint4*)(halves + i);
                const unsigned int pairs[4] = {words.x, words.y, words.z, words.w};
#pragma unroll
                for (int n = 0; n < 4; n++)
                    size += half_value(pairs[n] & 0xffff) + half_value(pairs[n] >> 16);
            }
        else
            for (int i = part; i < tensor.n_features; i += is_shared ? SIZES_THREADS : 1)
                size = larger(size, tensor.is_half ? half_value(halves[i]) : floats[i]);
    }
    size = fabsf(size);
    if (is_shared)
        for (int mask = SIZES_THREADS / 2; mask; mask /= 2)
            size = larger(size, __shfl_xor_sync(~0u, size, mask));
    if (part || !exists)
        return;
    int row = t * p.n_tensors + blockIdx.y;
    p.sizes[(long long)row * p.n_lanes + lane] = size;
    if (!(size <= p.limit))
        atomicMin(p.first_rows + lane, row);  // the same whatever the order
}

// The sum of a number over a block, in every thread.
static __device__ int sum_of_block(int x) {
    __shared__ int of_warps[RECORD_THREADS / WARP];
    x = __reduce_add_sync(~0u, x);
    __syncthreads();
    if (threadIdx.x % WARP == 0)
        of_warps[threadIdx.x / WARP] = x;
    __syncthreads();
    return __reduce_add_sync(~0u, of_warps[threadIdx.x % WARP]);
}

// The smallest number of a block, in every thread.
static __device__ long long least_of_block(long long x) {
    __shared__ long long least;
    for (int mask = WARP / 2; mask; mask /= 2)
        x = min(x, __shfl_xor_sync(~0u, x, mask));
    __syncthreads();
    if (!threadIdx.x)
        least = x;
    __syncthreads();
    if (threadIdx.x % WARP == 0)
        atomicMin(&least, x);
    __syncthreads();
    return least;
}

// One block. Counts the rollout, and keeps the first numbers of up to n_named lanes, those of the
// smallest index in `sizes`, unless an earlier rollout's are still there.
KERNEL BOUNDS(1024) record(RecordParams p) {
    int n_bad = 0;
    for (int lane = threadIdx.x; lane < p.n_lanes; lane += RECORD_THREADS)
        n_bad += p.first_rows[lane] < p.n_rows;
    n_bad = sum_of_block(n_bad);
    double count = p.record[0] + 1.;
    bool is_first = n_bad && !(p.record[2] > 0.);
    __syncthreads();
    if (!threadIdx.x) {
        *p.is_finite = !n_bad;
        p.record[0] = count;
        if (is_first) {
            p.record[2] = count;
            p.record[3] = n_bad;
        }
    }
    if (!is_first)
        return;
    long long last = -1, none = (long long)p.n_rows * p.n_lanes;
    for (int i = 0; i < p.n_named; i++) {
        long long index = none;
        for (int lane = threadIdx.x; lane < p.n_lanes; lane += RECORD_THREADS) {
            long long candidate = (long long)p.first_rows[lane] * p.n_lanes + lane;
            if (p.first_rows[lane] < p.n_rows && candidate > last)
                index = min(index, candidate);
        }
        index = last = least_of_block(index);
        if (!threadIdx.x) {
            float size = index < none ? p.sizes[index] : 0.f;
            p.record[4 + i] = (double)index;
            p.record[4 + p.n_named + i] = isnan(size)   ? -1.
                                          : isinf(size) ? 1.7976931348623157e308
                                                        : (double)size;
        }
        if (index == none)
            break;
    }
}
