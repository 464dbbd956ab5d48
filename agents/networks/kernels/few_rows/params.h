// The parameters of each launch, passed by value; see megastep/kernels/params.h.
#pragma once

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

// A step of the LSTM: B lanes, W units. Gates are in the order input, forget, candidate, output.
struct LstmStepParams {
    const void* x;               // (B, W) bfloat16
    const void* weight;          // (4 W, 2 W) bfloat16: of x, then of the last output
    const void* bias;            // (4 W) bfloat16
    const unsigned char* reset;  // (B)
    const float* last_output;    // (B, W)
    const float* last_cell;      // (B, W)
    void* output;                // (B, W) bfloat16
    float* next_output;          // (B, W), the same numbers without the residual
    float* next_cell;            // (B, W)
    int n_lanes;                 // B
    int is_residual;             // 1: adds x to `output`. 0: does not
};
