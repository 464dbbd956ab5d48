// Macros that are spelt differently on the CPU and on the GPU:
//   KERNEL         declares an operation that Python can launch
//   HAS_THREADS    defined where KERNEL is a function of one thread
//   EACH           defines an operation in a header, for both: a statement about parameters p and
//                  each i below `count`; `threads` of the CPU may depend on n, the count
//   HD             declares a function for both
//   RARE           as HD, but calls of it are not inlined on a GPU and in WebAssembly
//   ALIGNED, LOAD  16-byte records, and reading one in one instruction
//   OR_BITS, ADD   update a word that other threads may update too
//   COUNT_BITS     number of bits set
//   SIMD_OR        before a loop of SIMD_STEPS that ORs into a word: compilers vectorise it
//   HALF_BITS, HALF_VALUE          between float and fp16
//   NAN_VALUE, INF_VALUE
//   SQRT, CEIL, FLOOR, RINT        of a float, correctly rounded
//   ABS            magnitude of a float
//   TO_INT         a float cut to an int; NaN is 0, and what is too large the nearest int
//   RECIPROCAL     correctly rounded if argument and result are normal floats, else undefined
//
// CPU and GPU agree on every bit. That takes no fused multiply-add (a compiler flag on either
// side), IEEE division and square root, and our own sine and cosine.
#pragma once
#ifdef __CUDACC__
#include "common/backend_cuda.h"
#else
#include "common/backend_cpu.h"
#endif

#ifdef HAS_THREADS
#define EACH(operation, Params, count, threads, ...)              \
    KERNEL operation(Params p) {                                  \
        wait_for_previous();                                      \
        int n = count, i = blockIdx.x * blockDim.x + threadIdx.x; \
        if (i < n)                                                \
            __VA_ARGS__;                                          \
    }
#else
#define EACH(operation, Params, count, threads, ...)                                               \
    KERNEL operation(const Params& p) {                                                            \
        int n = count, n_threads = threads;                                                        \
        _Pragma("omp parallel for schedule(static) num_threads(n_threads)") for (int i = 0; i < n; \
                                                                                 i++) __VA_ARGS__; \
    }
#endif
