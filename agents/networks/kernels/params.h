// What each launch is given, by value; Python reads these structs, one field per line.
//
// T steps, B lanes, W units. "compute" stands for the dtype of matrix products, float or bfloat16.
#pragma once

// The LSTM. A null pointer: there is no next step. Gates are those before their activation: input,
// forget, candidate, output. The memory is the output, and the cell, as the step sees them: zero
// where a reset has cleared them.

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

// The minGRU. Gates are the update gate before its activation, and the candidate. The start is the
// state before the first step, the last that after the last.

struct MingruForwardParams {
    const void* gates;           // (T, B, 2 W) compute
    const unsigned char* reset;  // (T, B)
    const float* start;          // (B, W)
    void* outputs;               // (T, B, W) compute
    float* last;                 // (B, W)
    int n_steps;
    int n_lanes;
    int width;
    int n_units;  // of one thread
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
    int n_units;  // of one thread
};
