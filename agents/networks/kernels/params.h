// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// T steps, B lanes, W units. "compute" is the dtype of matrix products, float32 or bfloat16.
#pragma once

// The LSTM. Gates are before activation, in the order input, forget, candidate, output. `hidden`
// and `cell` are a step's input state: the last step's output and cell, zeroed where a reset clears
// them. A null pointer means that there is no next step.

struct LstmStartParams {
    const unsigned char* reset;  // (B) at the first step
    const float* last_output;    // (B, W)
    const float* last_cell;      // (B, W)
    void* hidden;                // (B, W) compute
    float* cell;                 // (B, W)
    int n_lanes;
    int width;
    int n_units;  // units per thread
};

struct LstmForwardParams {
    const void* gates;                // (B, 4 W) compute
    const float* cell;                // (B, W)
    const unsigned char* next_reset;  // (B)
    void* output;                     // (B, W) compute
    void* next_hidden;                // (B, W) compute
    float* next_cell;                 // (B, W)
    int n_lanes;
    int width;
    int n_units;  // units per thread
};

struct LstmBackwardParams {
    const void* gates;                // (B, 4 W) compute
    const float* cell;                // (B, W)
    const unsigned char* next_reset;  // (B)
    const void* d_output;             // (B, W) compute
    const void* d_next_hidden;        // (B, W) compute
    const float* d_next_cell;         // (B, W)
    void* d_gates;                    // (B, 4 W) compute
    float* d_cell;                    // (B, W)
    int n_lanes;
    int width;
    int n_units;  // units per thread
};

// The minGRU. Gates are the update gate before activation, and the candidate. `start` is the state
// before the first step, `last` the state after the last.

struct MingruForwardParams {
    const void* gates;           // (T, B, 2 W) compute
    const unsigned char* reset;  // (T, B)
    const float* start;          // (B, W)
    void* outputs;               // (T, B, W) compute
    float* last;                 // (B, W)
    int n_steps;
    int n_lanes;
    int width;
    int n_units;  // units per thread
};

struct MingruBackwardParams {
    const void* gates;           // (T, B, 2 W) compute
    const unsigned char* reset;  // (T, B)
    const float* start;          // (B, W)
    const void* outputs;         // (T, B, W) compute
    const void* d_outputs;       // (T, B, W) compute
    const float* d_last;         // (B, W)
    void* d_gates;               // (T, B, 2 W) compute
    float* d_start;              // (B, W)
    int n_steps;
    int n_lanes;
    int width;
    int n_units;  // units per thread
};
