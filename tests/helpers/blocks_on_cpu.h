// Lets CUDA kernels compile for a CPU, and runs them there a block, or a cluster of blocks, at a
// time. Every thread is a fiber, which runs until it needs what other threads have not done yet: a
// shuffle, a vote, a sum, a barrier. Unlike a GPU it notices threads that never come.
#pragma once
#include <setjmp.h>
#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <functional>
#include <numeric>
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

struct float2 {
    float x, y;
};
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
constexpr unsigned int SHARED_BYTES = 1 << 18;  // of a block
constexpr unsigned int MAX_BLOCKS = 4;          // of a cluster
alignas(128) static unsigned char cluster_shared[MAX_BLOCKS][SHARED_BYTES];
static unsigned char* dynamic_shared;  // that of the current block
constexpr unsigned char POISON = 0x7f;
constexpr unsigned int GUARD = 1024;  // bytes behind the shared memory
typedef unsigned long long Bits64;

// ---- Fibers ----

constexpr int MAX_FIBERS = 1024;
constexpr size_t STACK_BYTES = 1 << 16;

// Something that a GPU does in its own time.
typedef std::function<void()> Job;

struct Fiber {
    std::vector<char> stack;
    jmp_buf place;
    bool is_started, is_done;
    std::deque<std::vector<Job>> copies;  // begun, by group; the last group is still open
};
static Fiber fibers[MAX_FIBERS];
static std::vector<Job> jobs;  // of no fiber
static bool is_late;           // whether jobs are done as late as they may be, or at once
static bool is_mixed;          // whether some are late
static jmp_buf scheduler;
static int current, n_fibers, n_threads_of_block;
static unsigned int first_block;
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

// The number of the current block in its cluster.
static unsigned int block_rank() { return current / n_threads_of_block; }

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

static unsigned int random_bits;

static unsigned int random_below(unsigned int n) {
    random_bits = random_bits * 1664525u + 1013904223u;
    return (unsigned int)((Bits64)random_bits * n >> 32);
}

// Jobs that are late are done when nothing else can be; some later still if they are mixed.
static void do_jobs() {
    std::vector<Job> all;
    all.swap(jobs);
    for (Job& job : all) {
        if (is_mixed && random_below(2))
            jobs.push_back(job);
        else
            job();
    }
}

// In which order warps, and the threads of each, run. A warp runs until none of its threads gets
// on while all others stand still; if shuffled, often only part of the way. Every launch is
// shuffled alike, so that a failure comes again.
enum class Order { FORWARD, REVERSED, SHUFFLED };

static void shuffle_numbers(std::vector<int>& numbers) {
    for (size_t i = numbers.size(); i > 1; i--)
        std::swap(numbers[i - 1], numbers[random_below(i)]);
}

// Continues the threads of a warp. Returns whether it has threads that have not ended.
static bool run_warp(int warp, const std::vector<int>& lanes, Order order) {
    int n_rounds = order == Order::SHUFFLED ? 1 << random_below(12) : 1 << 30;
    bool is_alive = true, gets_on = true;
    for (; is_alive && gets_on && n_rounds && !failure[0]; n_rounds--) {
        long long before = n_events;
        is_alive = false;
        for (int lane : lanes) {
            current = WARP * warp + lane;
            if (failure[0] || current >= n_fibers || fibers[current].is_done)
                continue;
            is_alive = true;
            threadIdx = {(unsigned int)(current % n_threads_of_block), 0};
            blockIdx.x = first_block + block_rank();
            dynamic_shared = cluster_shared[block_rank()];
            resume();
        }
        gets_on = n_events != before;
    }
    return is_alive;
}

static void run_cluster(Order order) {
    std::vector<int> warps((n_fibers + WARP - 1) / WARP), lanes(WARP);
    for (std::vector<int>* numbers : {&warps, &lanes}) {
        std::iota(numbers->begin(), numbers->end(), 0);
        if (order == Order::REVERSED)
            std::reverse(numbers->begin(), numbers->end());
    }
    for (int i = 0; i < n_fibers; i++) {
        fibers[i].is_done = false;
        fibers[i].copies.assign(1, {});
    }
    jobs.clear();
    for (bool is_alive = true; is_alive && !failure[0];) {
        long long before = n_events;
        is_alive = false;
        if (order == Order::SHUFFLED)
            shuffle_numbers(warps);
        for (int warp : warps) {
            if (order == Order::SHUFFLED)
                shuffle_numbers(lanes);
            is_alive |= run_warp(warp, lanes, order);
        }
        if (!jobs.empty() && n_events == before)
            do_jobs();
        else if (is_alive && n_events == before && !failure[0])
            snprintf(failure, sizeof failure, "block %u: its threads wait for each other",
                     blockIdx.x);
    }
    while (!jobs.empty() && !failure[0])
        do_jobs();  // which come too late, and say so
    if (failure[0])
        for (Fiber& fiber : fibers)
            fiber.is_started = false;
}

// ---- Meetings: of the threads of a mask, of a block or of a cluster ----

// The operations that threads meet in. All threads of a meeting must be in the same one.
enum Operation { SYNC, SHUFFLE, VOTE, SUM, LEAST, LARGEST, UNION, LOAD_MATRICES, MULTIPLY };

// What the threads bring to their last two meetings: a thread that reads one may find others in
// the next.
struct Meeting {
    unsigned int mask;
    int first;  // thread of the warp
    int counts[WARP];
    Bits64 values[2][WARP];
    Operation operations[2][WARP];
};
static std::vector<Meeting> meetings;  // of the cluster

static Bits64* meet(unsigned int mask, Bits64 value, Operation operation) {
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

// What the threads bring to their last two meetings of all of a block, or of a cluster.
struct Barrier {
    int counts[MAX_FIBERS], values[2][MAX_FIBERS];
};
static Barrier block_barrier, cluster_barriers;

// Meets `n` threads from `first` on. Those that have ended are not waited for.
static int meet_all(Barrier& barrier, int first, int n, int value) {
    int count = barrier.counts[current]++, slot = count % 2, any = 0;
    barrier.values[slot][current] = value;
    n_events++;
    for (int other = first; other < first + n; other++)
        while (!fibers[other].is_done && barrier.counts[other] <= count)
            yield();
    for (int other = first; other < first + n; other++)
        if (barrier.counts[other] > count)
            any |= barrier.values[slot][other];
    return any;
}

static int meet_block(int value) {
    int first = current - current % n_threads_of_block;
    return meet_all(block_barrier, first, n_threads_of_block, value);
}

template <class T>
static Bits64 bits_of(T x) {
    Bits64 bits = 0;
    memcpy(&bits, &x, sizeof x);
    return bits;
}

template <class T>
static T from_bits(Bits64 bits) {
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
    Bits64* values = meet(mask, bits_of(x), SHUFFLE);
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
    Bits64* values = meet(mask, is_set != 0, VOTE);
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
    Bits64* values = meet(mask, bits_of(x), operation);
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
// Bytes of y, then x, by the four selectors' lowest three bits.
static unsigned int __byte_perm(unsigned int x, unsigned int y, unsigned int selectors) {
    Bits64 bytes = (Bits64)y << 32 | x;
    unsigned int result = 0;
    for (int i = 0; i < 4; i++)
        result |= (unsigned int)(bytes >> 8 * (selectors >> 4 * i & 7) & 255) << 8 * i;
    return result;
}
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
template <class T>
static T __ldcs(const T* address) {
    return *address;
}
template <class T>
static void __stcs(T* address, T x) {
    *address = x;
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
// block; arrays of a fixed size hold what the last block left there, and are the same for all
// blocks of a cluster.
template <class Params>
const char* launch_blocks(void (*kernel)(Params), const Params& params, unsigned int n_blocks_x,
                          unsigned int n_blocks_y, unsigned int n_threads, unsigned int n_shared,
                          unsigned int cluster, Order order, int jobs_are_late) {
    failure[0] = 0;
    if (cluster * n_threads > MAX_FIBERS || cluster > MAX_BLOCKS ||
        n_shared + GUARD > SHARED_BYTES || n_blocks_x % cluster)
        return "has more threads or shared memory than fit, or part of a cluster";
    n_fibers = (int)(cluster * n_threads);
    n_threads_of_block = (int)n_threads;
    is_late = jobs_are_late;
    is_mixed = is_late && order == Order::SHUFFLED;
    random_bits = 0;
    blockDim = {n_threads, 1};
    gridDim = {n_blocks_x, n_blocks_y};
    kernel_call = [&] { kernel(params); };
    unsigned int n_clusters = n_blocks_x / cluster * n_blocks_y;
    for (unsigned int k = 0; k < n_clusters && !failure[0]; k++) {
        unsigned int block = cluster * (order == Order::REVERSED ? n_clusters - 1 - k : k);
        first_block = block % n_blocks_x;
        blockIdx.y = block / n_blocks_x;
        meetings.clear();
        memset(&block_barrier, 0, sizeof block_barrier);
        memset(&cluster_barriers, 0, sizeof cluster_barriers);
        for (unsigned int rank = 0; rank < cluster; rank++)
            memset(cluster_shared[rank], POISON, n_shared + GUARD);
        run_cluster(order);
        for (unsigned int rank = 0; rank < cluster; rank++)
            for (unsigned int i = n_shared; i < n_shared + GUARD && !failure[0]; i++)
                if (cluster_shared[rank][i] != POISON)
                    snprintf(failure, sizeof failure, "block %u: writes beyond its shared memory",
                             first_block + rank);
    }
    return failure;
}
