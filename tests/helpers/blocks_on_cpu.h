// Lets CUDA kernels compile for a CPU, and runs them there a block at a time. Every thread of a
// block is a fiber, which runs until it needs what other threads have not done yet: a shuffle, a
// vote, a sum, a barrier. Unlike a GPU it notices threads that never come.
#pragma once
#include <setjmp.h>
#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <vector>

#define __device__
#define __forceinline__ inline
#define __global__
#define __launch_bounds__(...)
#define __shared__ static
#define __expf expf

#include "common/constants.h"
#include "common/dependent_launch.h"

using std::isfinite;
using std::isinf;
using std::isnan;
using std::max;
using std::min;

struct float4 {
    float x, y, z, w;
};
struct double2 {
    double x, y;
};
struct uint2 {
    unsigned int x, y;
};
struct uint4 {
    unsigned int x, y, z, w;
};
static inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
static inline uint4 make_uint4(unsigned int x, unsigned int y, unsigned int z, unsigned int w) {
    return {x, y, z, w};
}
struct Index {
    unsigned int x, y;
};
static Index blockIdx, threadIdx, blockDim, gridDim;
alignas(16) static unsigned char dynamic_shared[1 << 18];
constexpr unsigned char POISON = 0x7f;
constexpr unsigned int GUARD = 1024;  // bytes behind the shared memory
typedef unsigned long long Bits;

// ---- Fibers ----

constexpr int MAX_FIBERS = 1024;
constexpr size_t STACK_BYTES = 1 << 16;

struct Fiber {
    std::vector<char> stack;
    jmp_buf place;
    bool is_started, is_done;
};
static Fiber fibers[MAX_FIBERS];
static jmp_buf scheduler;
static int current, n_fibers;
static long long n_events;  // fibers that arrived somewhere or ended
static char failure[200];
static std::function<void()> kernel_call;

static void yield() {
    if (!_setjmp(fibers[current].place))
        _longjmp(scheduler, 1);
}

// Ends the launch.
static void fail(const char* message, int thread) {
    if (!failure[0])
        snprintf(failure, sizeof failure, "block %u, thread %d: %s (thread %d)", blockIdx.x,
                 current, message, thread);
    for (;;)
        yield();
}

// Runs a thread of each block.
static void fiber_main() {
    for (;;) {
        kernel_call();
        fibers[current].is_done = true;
        n_events++;
        yield();
    }
}

// Continues the current fiber until it yields. setcontext only starts a stack, since it asks the
// operating system each time.
static void resume() {
    Fiber& fiber = fibers[current];
    if (_setjmp(scheduler))
        return;
    if (fiber.is_started)
        _longjmp(fiber.place, 1);
    ucontext_t start;
    fiber.is_started = true;
    fiber.stack.resize(STACK_BYTES);
    getcontext(&start);
    start.uc_stack.ss_sp = fiber.stack.data();
    start.uc_stack.ss_size = STACK_BYTES;
    start.uc_link = nullptr;
    makecontext(&start, fiber_main, 0);
    setcontext(&start);
}

static void run_block(bool is_reversed) {
    for (int i = 0; i < n_fibers; i++)
        fibers[i].is_done = false;
    for (bool is_alive = true; is_alive && !failure[0];) {
        long long before = n_events;
        is_alive = false;
        for (int i = 0; i < n_fibers && !failure[0]; i++) {
            current = is_reversed ? n_fibers - 1 - i : i;
            if (fibers[current].is_done)
                continue;
            is_alive = true;
            threadIdx = {(unsigned int)current, 0};
            resume();
        }
        if (is_alive && n_events == before)
            snprintf(failure, sizeof failure, "block %u: its threads wait for each other",
                     blockIdx.x);
    }
    if (failure[0])
        for (Fiber& fiber : fibers)
            fiber.is_started = false;
}

// ---- Meetings: of the threads of a mask, or of a block ----

// The operations that threads meet in. All threads of a meeting must be in the same one.
enum Operation { SYNC, SHUFFLE, VOTE, SUM, LEAST, LARGEST, UNION };

// What the threads bring to their last two meetings: a thread that reads one may find others in
// the next.
struct Meeting {
    unsigned int mask;
    int first;  // thread of the warp
    int counts[WARP];
    Bits values[2][WARP];
    Operation operations[2][WARP];
};
static std::vector<Meeting> meetings;  // of the block

static Bits* meet(unsigned int mask, Bits value, Operation operation) {
    int lane = current % WARP, first = current - lane;
    if (!(mask >> lane & 1))
        fail("not in its own mask", current);
    size_t k = 0;
    while (k < meetings.size() && (meetings[k].mask != mask || meetings[k].first != first))
        k++;
    if (k == meetings.size())
        meetings.push_back({mask, first, {}, {}, {}});
    int count = meetings[k].counts[lane]++, slot = count % 2;
    meetings[k].values[slot][lane] = value;
    meetings[k].operations[slot][lane] = operation;
    n_events++;
    for (int other = 0; other < WARP; other++) {
        if (!(mask >> other & 1))
            continue;
        while (meetings[k].counts[other] <= count) {
            if (first + other >= n_fibers || fibers[first + other].is_done)
                fail("meets a thread that has ended", first + other);
            yield();
        }
    }
    for (int other = 0; other < WARP; other++)
        if ((mask >> other & 1) && meetings[k].operations[slot][other] != operation)
            fail("meets a thread in another operation", first + other);
    return meetings[k].values[slot];
}

static int block_counts[MAX_FIBERS], block_values[2][MAX_FIBERS];

// Threads that have ended are not waited for.
static int meet_block(int value) {
    int count = block_counts[current]++, slot = count % 2, any = 0;
    block_values[slot][current] = value;
    n_events++;
    for (int other = 0; other < n_fibers; other++)
        while (!fibers[other].is_done && block_counts[other] <= count)
            yield();
    for (int other = 0; other < n_fibers; other++)
        if (block_counts[other] > count)
            any |= block_values[slot][other];
    return any;
}

template <class T>
static Bits bits_of(T x) {
    Bits bits = 0;
    memcpy(&bits, &x, sizeof x);
    return bits;
}

template <class T>
static T from_bits(Bits bits) {
    T x;
    memcpy(&x, &bits, sizeof x);
    return x;
}

// ---- CUDA's functions ----

static void __syncthreads() { meet_block(0); }
static int __syncthreads_or(int value) { return meet_block(value); }
static int __syncthreads_and(int value) { return !meet_block(!value); }
static void __syncwarp(unsigned int mask = ~0u) { meet(mask, 0u, SYNC); }

template <class T>
static T shuffle(unsigned int mask, T x, int from) {
    Bits* values = meet(mask, bits_of(x), SHUFFLE);
    if (!(mask >> from & 1))
        fail("reads from outside its mask", from);
    return from_bits<T>(values[from]);
}
// `width` neighbouring threads are a group of their own. A thread whose partner would be outside
// has its own number.
template <class T>
static T __shfl_sync(unsigned int mask, T x, int from, int width = WARP) {
    return shuffle(mask, x, (current % WARP & -width) + (from & (width - 1)));
}
template <class T>
static T __shfl_xor_sync(unsigned int mask, T x, int lanes, int width = WARP) {
    int lane = current % WARP, from = lane ^ lanes;
    return shuffle(mask, x, from < (lane & -width) + width ? from : lane);
}
template <class T>
static T __shfl_down_sync(unsigned int mask, T x, int lanes, int width = WARP) {
    int lane = current % WARP, from = lane + lanes;
    return shuffle(mask, x, from < (lane & -width) + width ? from : lane);
}
template <class T>
static T __shfl_up_sync(unsigned int mask, T x, int lanes, int width = WARP) {
    int lane = current % WARP, from = lane - lanes;
    return shuffle(mask, x, from >= (lane & -width) ? from : lane);
}

static unsigned int __ballot_sync(unsigned int mask, int is_set) {
    Bits* values = meet(mask, is_set != 0, VOTE);
    unsigned int votes = 0;
    for (int lane = 0; lane < WARP; lane++)
        if (mask >> lane & 1)
            votes |= (unsigned int)values[lane] << lane;
    return votes;
}
static int __any_sync(unsigned int mask, int is_set) { return __ballot_sync(mask, is_set) != 0; }
static int __all_sync(unsigned int mask, int is_set) { return __ballot_sync(mask, is_set) == mask; }

template <class T, class Combine>
static T reduce(unsigned int mask, T x, Operation operation, Combine combine) {
    Bits* values = meet(mask, bits_of(x), operation);
    int first = __builtin_ctz(mask);
    T result = from_bits<T>(values[first]);
    for (int lane = first + 1; lane < WARP; lane++)
        if (mask >> lane & 1)
            result = combine(result, from_bits<T>(values[lane]));
    return result;
}
template <class T>
static T __reduce_add_sync(unsigned int mask, T x) {
    return reduce(mask, x, SUM, [](T a, T b) { return a + b; });
}
template <class T>
static T __reduce_min_sync(unsigned int mask, T x) {
    return reduce(mask, x, LEAST, [](T a, T b) { return min(a, b); });
}
template <class T>
static T __reduce_max_sync(unsigned int mask, T x) {
    return reduce(mask, x, LARGEST, [](T a, T b) { return max(a, b); });
}
static unsigned int __reduce_or_sync(unsigned int mask, unsigned int bits) {
    return reduce(mask, bits, UNION, [](unsigned int a, unsigned int b) { return a | b; });
}

static int __ffs(unsigned int bits) { return __builtin_ffs((int)bits); }
static int __clz(unsigned int bits) { return bits ? __builtin_clz(bits) : 32; }
static int __popc(unsigned int bits) { return __builtin_popcount(bits); }
static unsigned int __float_as_uint(float x) { return (unsigned int)bits_of(x); }
static float __uint_as_float(unsigned int bits) { return from_bits<float>(bits); }
static float __int_as_float(int bits) { return from_bits<float>((unsigned int)bits); }
static long long __double_as_longlong(double x) { return (long long)bits_of(x); }
static float __fdiv_rn(float x, float y) { return x / y; }
// As CUDA documents it: a divisor above 2^126 gives 0.
static float __fdividef(float x, float y) { return fabsf(y) > 0x1p126f ? x * 0.f : x / y; }
template <class T>
static T __ldcg(const T* address) {
    return *address;
}

// Only one fiber runs at a time.
template <class T>
static T atomicAdd(T* address, T x) {
    T before = *address;
    *address = before + x;
    return before;
}
template <class T>
static T atomicMin(T* address, T x) {
    T before = *address;
    *address = min(before, x);
    return before;
}
template <class T>
static T atomicMax(T* address, T x) {
    T before = *address;
    *address = max(before, x);
    return before;
}

// Not _Float16, which older compilers lack.
static float half_to_float(unsigned short bits) {
    int exponent = bits >> 10 & 31, mantissa = bits & 1023;
    float x = exponent ? ldexpf(1024.f + mantissa, exponent - 25) : ldexpf(mantissa, -24);
    if (exponent == 31)
        x = mantissa ? NAN : INFINITY;
    return bits >> 15 ? -x : x;
}

// ---- Launching ----

// Returns what went wrong, or an empty text. Dynamic shared memory holds huge numbers before a
// block; arrays of a fixed size hold what the last block left there.
template <class Params>
const char* launch_blocks(void (*kernel)(Params), const Params& params, unsigned int n_blocks_x,
                          unsigned int n_blocks_y, unsigned int n_threads, unsigned int n_shared,
                          int is_reversed) {
    failure[0] = 0;
    if (n_threads > MAX_FIBERS || n_shared + GUARD > sizeof dynamic_shared)
        return "has more threads or shared memory than fit";
    n_fibers = (int)n_threads;
    blockDim = {n_threads, 1};
    gridDim = {n_blocks_x, n_blocks_y};
    kernel_call = [&] { kernel(params); };
    unsigned int n_blocks = n_blocks_x * n_blocks_y;
    for (unsigned int k = 0; k < n_blocks && !failure[0]; k++) {
        unsigned int block = is_reversed ? n_blocks - 1 - k : k;
        blockIdx = {block % n_blocks_x, block / n_blocks_x};
        meetings.clear();
        memset(block_counts, 0, sizeof block_counts);
        memset(dynamic_shared, POISON, n_shared + GUARD);
        run_block(is_reversed);
        for (unsigned int i = n_shared; i < n_shared + GUARD && !failure[0]; i++)
            if (dynamic_shared[i] != POISON)
                snprintf(failure, sizeof failure, "block %u: writes beyond its shared memory",
                         blockIdx.x);
    }
    return failure;
}
