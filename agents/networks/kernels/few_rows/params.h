// The parameters of each launch, passed by value; see megastep/kernels/params.h.
#pragma once

constexpr int MAX_ROWS = 2048;     // of a product; of more, larger blocks are faster
constexpr int TILE = 64;           // rows and columns of a block's results
constexpr int TILE_THREADS = 128;  // of a block
constexpr int TILE_BYTES = 36864;  // of a block's shared memory

// A matrix product: (M, K) times (K, N). Strides are numbers from one row in memory to the next.
struct ProductParams {
    const void* left;    // (M, K) bfloat16
    const void* right;   // bfloat16: (N, K) in memory, or (K, N)
    const void* bias;    // (N) bfloat16; null: none
    const void* addend;  // (M, N) bfloat16, with the stride of the result; null: none
    void* result;        // (M, N) bfloat16
    int n_rows;          // M
    int n_columns;       // N, a multiple of 8
    int n_inner;         // K
    int left_stride;     // a multiple of 8, as the other strides
    int right_stride;
    int result_stride;
    int has_relu;
};
