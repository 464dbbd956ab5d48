// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// T steps, B lanes, W units. Arrays are bfloat16 unless their type says otherwise. C is the number
// of clusters, S = W / 64 that of blocks per cluster.
#pragma once

struct LstmSequenceForwardParams {
    const void* gates;           // (T, B, 4 W), products of the inputs, with the bias
    const void* weight;          // (4 W, W), recurrent
    const unsigned char* reset;  // (T, B)
    const float* last_output;    // (B, W), before the sequence
    const float* last_cell;      // (B, W)
    const void* residual;        // (T, B, W), added to the outputs; null: nothing is
    void* outputs;               // (T, B, W)
    void* hiddens;               // (T, B, W), each step's recurrent input
    float* output;               // (B, W), after the sequence, without the residual
    float* cell;                 // (B, W), after the sequence
    void* saved_gates;           // (T, C, S, 5, 256, 8), before activation; null: not saved
    float* saved_cells;          // (T, C, S, 5, 256, 2), each step's input
    int n_steps;
    int n_lanes;
    int n_clusters;
};

struct LstmSequenceBackwardParams {
    const void* weight;          // (W, 4 W), recurrent, transposed
    const unsigned char* reset;  // (T, B)
    const void* saved_gates;     // of the forward pass
    const float* saved_cells;
    const void* d_outputs;  // (T, B, W)
    const float* d_cell;    // (B, W); null: 0
    void* d_gates;          // (T, B, 4 W)
    float* d_bias;          // (C, 4 W), sums over each cluster's lanes
    float* d_last_output;   // (B, W)
    float* d_last_cell;     // (B, W)
    int n_steps;
    int n_lanes;
    int n_clusters;
};
