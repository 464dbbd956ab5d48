// Matrix products on tensor cores, asynchronous copies, and clusters of blocks (Hopper and later).
#pragma once
#include "common/dependent_launch.h"

// ---- Numbers ----

typedef unsigned short Bits;  // of a bfloat16

DEVICE float low_half(unsigned int pair) { return __uint_as_float(pair << 16); }

DEVICE float high_half(unsigned int pair) { return __uint_as_float(pair & 0xffff0000u); }

// Rounds two floats to bfloat16, to nearest even. NaN stays NaN.
DEVICE unsigned int pack_bfloat16(float low, float high) {
    unsigned int pair;
    asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(pair) : "f"(high), "f"(low));
    return pair;
}

// Rounds the positive parts of two floats. NaN stays NaN.
DEVICE unsigned int pack_relu(float low, float high) {
    unsigned int pair;
    asm("cvt.rn.relu.bf16x2.f32 %0, %1, %2;" : "=r"(pair) : "f"(high), "f"(low));
    return pair;
}

// Clears the halves of `pair` where those of `activated` are not above 0. NaN counts as above.
DEVICE unsigned int where_active(unsigned int activated, unsigned int pair) {
    unsigned int mask;
    asm("set.gtu.u32.bf16x2 %0, %1, %2;" : "=r"(mask) : "r"(activated), "r"(0u));
    return pair & mask;
}

// The hardware's approximation: its relative error, 2^-11, is below the rounding of the argument to
// bfloat16. NaN stays NaN.
DEVICE float tanh_of(float x) {
    float y;
    asm("tanh.approx.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
}

DEVICE float sigmoid(float x) { return 0.5f * tanh_of(0.5f * x) + 0.5f; }

// ---- Tensor cores ----

// Loads two matrices of 8 x 8 bfloat16, or four. Lanes 8 i to 8 i + 7 of the warp give the rows of
// matrix i.
DEVICE void load_matrices(unsigned int (&parts)[2], const void* row) {
    unsigned int address = (unsigned int)__cvta_generic_to_shared(row);
    asm volatile("ldmatrix.sync.aligned.m8n8.x2.shared.b16 {%0, %1}, [%2];"
                 : "=r"(parts[0]), "=r"(parts[1])
                 : "r"(address)
                 : "memory");
}

DEVICE void load_matrices(unsigned int (&first)[2], unsigned int (&second)[2], const void* row) {
    unsigned int address = (unsigned int)__cvta_generic_to_shared(row);
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0, %1, %2, %3}, [%4];"
                 : "=r"(first[0]), "=r"(first[1]), "=r"(second[0]), "=r"(second[1])
                 : "r"(address)
                 : "memory");
}

DEVICE void load_matrices(unsigned int (&parts)[4], const void* row) {
    load_matrices((unsigned int (&)[2])parts[0], (unsigned int (&)[2])parts[2], row);
}

// As load_matrices, transposed.
DEVICE void load_transposed(unsigned int (&parts)[2], const void* row) {
    unsigned int address = (unsigned int)__cvta_generic_to_shared(row);
    asm volatile("ldmatrix.sync.aligned.m8n8.x2.trans.shared.b16 {%0, %1}, [%2];"
                 : "=r"(parts[0]), "=r"(parts[1])
                 : "r"(address)
                 : "memory");
}

DEVICE void load_transposed(unsigned int (&first)[2], unsigned int (&second)[2], const void* row) {
    unsigned int address = (unsigned int)__cvta_generic_to_shared(row);
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0, %1, %2, %3}, [%4];"
                 : "=r"(first[0]), "=r"(first[1]), "=r"(second[0]), "=r"(second[1])
                 : "r"(address)
                 : "memory");
}

// sum (16 x 8) += a (16 x 16) b (16 x 8), a and b in bfloat16.
DEVICE void multiply_add(float (&sum)[4], const unsigned int (&a)[4], unsigned int b0,
                         unsigned int b1) {
    asm volatile(
        "mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0, %1, %2, %3}, "
        "{%4, %5, %6, %7}, {%8, %9}, {%0, %1, %2, %3};"
        : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
        : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}

#ifdef __CUDA_ARCH_FEAT_SM90_ALL

// Products of the four warps of a group, which are begun one after the other (wgmma).
constexpr int GROUP_ROWS = 64;

// A matrix of rows of 64 numbers at a multiple of 1,024 bytes, whose eight words of 16 bytes are
// swizzled: word i of row r is at i ^ r % 8. Words i on are at the matrix + i.
DEVICE unsigned long long swizzled_matrix(const void* first) {
    constexpr unsigned long long EIGHT_ROWS = 1024 / 16, SWIZZLE_128 = 1;
    unsigned int address = (unsigned int)__cvta_generic_to_shared(first);
    return address / 16 | EIGHT_ROWS << 32 | SWIZZLE_128 << 62;
}

DEVICE void begin_multiplying() { asm volatile("wgmma.fence.sync.aligned;" ::: "memory"); }

#define FOUR(i) "+f"(sums[i][0]), "+f"(sums[i][1]), "+f"(sums[i][2]), "+f"(sums[i][3])
#define SUMS                                                                                  \
    FOUR(0), FOUR(1), FOUR(2), FOUR(3), FOUR(4), FOUR(5), FOUR(6), FOUR(7), FOUR(8), FOUR(9), \
        FOUR(10), FOUR(11), FOUR(12), FOUR(13), FOUR(14), FOUR(15)

// Waits until all sums are there. Compilers, too, must read them after it.
DEVICE void end_multiplying(float (&sums)[16][4]) {
    asm volatile("wgmma.commit_group.sync.aligned;\nwgmma.wait_group.sync.aligned 0;"
                 : SUMS::"memory");
}

// sums (64 x 128) += a (64 x 16) b (16 x 128): the next two words of 64 rows and of 128 rows. A
// thread has numbers 2 q and 2 q + 1 of each 8 columns, of row g of its warp's 16 and of row g + 8.
DEVICE void multiply_add(float (&sums)[16][4], unsigned long long a, unsigned long long b) {
    asm volatile(
        "wgmma.mma_async.sync.aligned.m64n128k16.f32.bf16.bf16 {"
        "%0, %1, %2, %3, %4, %5, %6, %7, %8, %9, %10, %11, %12, %13, %14, %15, "
        "%16, %17, %18, %19, %20, %21, %22, %23, %24, %25, %26, %27, %28, %29, %30, %31, "
        "%32, %33, %34, %35, %36, %37, %38, %39, %40, %41, %42, %43, %44, %45, %46, %47, "
        "%48, %49, %50, %51, %52, %53, %54, %55, %56, %57, %58, %59, %60, %61, %62, %63}, "
        "%64, %65, 1, 1, 1, 0, 0;"
        : SUMS
        : "l"(a), "l"(b));
}

#endif

// ---- Copies and clusters ----

// Begins to copy 16 bytes from global to shared memory.
DEVICE void begin_copy(void* shared, const void* global) {
    unsigned int address = (unsigned int)__cvta_generic_to_shared(shared);
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(address), "l"(global)
                 : "memory");
}

// Begins to copy 4, 8 or 16 bytes, or to clear them if there is nothing to copy.
template <int n_bytes>
DEVICE void begin_copy_or_clear(void* shared, const void* global, bool exists) {
    unsigned int address = (unsigned int)__cvta_generic_to_shared(shared);
    asm volatile("cp.async.ca.shared.global [%0], [%1], %2, %3;" ::"r"(address), "l"(global),
                 "n"(n_bytes), "r"(exists ? n_bytes : 0)
                 : "memory");
}

DEVICE void end_group() { asm volatile("cp.async.commit_group;" ::: "memory"); }

// Waits until this thread's groups of copies but the latest n are done.
template <int n>
DEVICE void wait_for_copies() {
    asm volatile("cp.async.wait_group %0;" ::"n"(n) : "memory");
}

DEVICE unsigned int cluster_rank() {
    unsigned int rank;
    asm("mov.u32 %0, %%cluster_ctarank;" : "=r"(rank));
    return rank;
}

// Waits until every thread of the cluster is here. What they wrote before is then visible to all.
DEVICE void cluster_barrier() {
    asm volatile(
        "barrier.cluster.arrive.release.aligned;\n"
        "barrier.cluster.wait.acquire.aligned;" ::
            : "memory");
}

// A barrier in shared memory that counts bytes which other blocks send. Each phase ends when one
// thread has announced the number of bytes and all have arrived.
typedef unsigned long long Arrivals;

DEVICE unsigned int shared_address(const void* shared) {
    return (unsigned int)__cvta_generic_to_shared(shared);
}

DEVICE void init(Arrivals* arrivals) {
    asm volatile(
        "mbarrier.init.shared.b64 [%0], 1;\n"
        "fence.mbarrier_init.release.cluster;" ::"r"(shared_address(arrivals))
        : "memory");
}

DEVICE void expect(Arrivals* arrivals, int n_bytes) {
    asm volatile(
        "mbarrier.arrive.expect_tx.shared.b64 _, [%0], %1;" ::"r"(shared_address(arrivals)),
        "r"(n_bytes)
        : "memory");
}

// Waits for the end of a phase: the first has number 0.
DEVICE void wait_for(Arrivals* arrivals, int phase) {
    unsigned int is_over;
    do {
        asm volatile(
            "{\n.reg .pred p;\n"
            "mbarrier.try_wait.parity.shared.b64 p, [%1], %2;\n"
            "selp.u32 %0, 1, 0, p;\n}"
            : "=r"(is_over)
            : "r"(shared_address(arrivals)), "r"(phase & 1)
            : "memory");
    } while (!is_over);
}

// Begins to copy from global to shared memory a multiple of 16 bytes, from and to a multiple of 16.
// `arrivals` count the bytes as they come.
DEVICE void begin_copy(void* shared, const void* global, int n_bytes, Arrivals* arrivals) {
    asm volatile(
        "cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes [%0], [%1], %2, [%3];" ::
            "r"(shared_address(shared)),
        "l"(global), "r"(n_bytes), "r"(shared_address(arrivals))
        : "memory");
}

// Where a block of the cluster has its copy of this shared memory.
DEVICE unsigned int address_in(const void* shared, unsigned int rank) {
    unsigned int there;
    asm("mapa.shared::cluster.u32 %0, %1, %2;"
        : "=r"(there)
        : "r"(shared_address(shared)), "r"(rank));
    return there;
}

// Lets this thread's writes to shared memory be sent by others of its block, after a barrier.
DEVICE void publish() { asm volatile("fence.proxy.async.shared::cta;" ::: "memory"); }

// Begins to copy from shared memory to that of a block of the cluster, a multiple of 16 bytes, from
// and to a multiple of 16. The other's `arrivals` count the bytes as they come.
DEVICE void send(unsigned int target, const void* source, int n_bytes, unsigned int arrivals) {
    asm volatile(
        "cp.async.bulk.shared::cluster.shared::cta.mbarrier::complete_tx::bytes [%0], [%1], %2, "
        "[%3];" ::"r"(target),
        "r"(shared_address(source)), "r"(n_bytes), "r"(arrivals)
        : "memory");
}
