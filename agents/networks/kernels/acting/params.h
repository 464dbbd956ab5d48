// The parameters of each launch, passed by value; see megastep/kernels/params.h.
// B lanes, W units.
#pragma once

// One step of the minGRU. `start` is the state before it, `last` the state after it.
struct MingruStepParams {
    const void* x;               // (B, W) bfloat16
    const void* weight;          // (2 W, W) bfloat16: of the update gate, then of the candidate
    const void* bias;            // (2 W) bfloat16
    const unsigned char* reset;  // (B)
    const float* start;          // (B, W)
    void* outputs;               // (B, W) bfloat16
    float* last;                 // (B, W)
    int n_lanes;                 // B
    int is_residual;             // 1: adds x to `outputs`. 0: does not
};
