// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// P policies, each with its own weights and its own B lanes of W units. Every array starts with the
// axis P.
#pragma once

// One step of the minGRU. `start` is the state before it, `last` the state after it.
struct MingruStepParams {
    const void* x;               // (P, B, W) bfloat16
    const void* weight;          // (P, 2 W, W) bfloat16: of the update gate, then of the candidate
    const void* bias;            // (P, 2 W) bfloat16
    const unsigned char* reset;  // (P, B)
    const float* start;          // (P, B, W)
    void* outputs;               // (P, B, W) bfloat16
    float* last;                 // (P, B, W)
    int n_lanes;                 // B
    int is_residual;             // 1: adds x to `outputs`. 0: does not
};
