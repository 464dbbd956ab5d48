// What each launch is given, by value; Python reads these structs, one field per line. A null
// pointer: there is no next step.
//
// B lanes, W units. "compute" stands for the dtype of matrix products, float or bfloat16. Gates
// are those before their activation: input, forget, candidate, output. The memory is the output,
// and the cell, as the step sees them: zero where a reset has cleared them.
#pragma once

struct LstmStartParams {
    const unsigned char* reset;  // (B) at the first step
    const float* last_output;    // (B, W)
    const float* last_cell;      // (B, W)
    void* memory;                // (B, W) compute
    float* cell;                 // (B, W)
    int n_lanes;
    int width;
    int n_units;  // of one thread
};

struct LstmForwardParams {
    const void* gates;                // (B, 4 W) compute
    const float* cell;                // (B, W)
    const unsigned char* next_reset;  // (B)
    void* output;                     // (B, W) compute
    void* next_memory;                // (B, W) compute
    float* next_cell;                 // (B, W)
    int n_lanes;
    int width;
    int n_units;  // of one thread
};

struct LstmBackwardParams {
    const void* gates;                // (B, 4 W) compute
    const float* cell;                // (B, W)
    const unsigned char* next_reset;  // (B)
    const void* d_output;             // (B, W) compute
    const void* d_next_memory;        // (B, W) compute
    const float* d_next_cell;         // (B, W)
    void* d_gates;                    // (B, 4 W) compute
    float* d_cell;                    // (B, W)
    int n_lanes;
    int width;
    int n_units;  // of one thread
};
