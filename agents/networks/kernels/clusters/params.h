// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// P policies, each with its own weights and its own B lanes, T steps, W units. Every array starts
// with the axis P. Arrays are bfloat16 unless their type says otherwise. C is the number of
// clusters per policy, S = W / 64 that of blocks per cluster.
#pragma once

struct LstmSequenceForwardParams {
    const void* gates;           // (P, T, B, 4 W), products of the inputs, with the bias
    const void* weight;          // (P, 4 W, W), recurrent
    const unsigned char* reset;  // (P, T, B)
    const float* last_output;    // (P, B, W), before the sequence
    const float* last_cell;      // (P, B, W)
    const void* residual;        // (P, T, B, W), added to the outputs; null: nothing is
    void* outputs;               // (P, T, B, W)
    void* hiddens;               // (P, T, B, W), each step's recurrent input
    float* output;               // (P, B, W), after the sequence, without the residual
    float* cell;                 // (P, B, W), after the sequence
    void* saved_gates;           // (P, T, C, S, 5, 256, 8), before activation; null: not saved
    float* saved_cells;          // (P, T, C, S, 5, 256, 2), each step's input
    int n_policies;
    int n_steps;
    int n_lanes;
    int n_clusters;
};

struct LstmSequenceBackwardParams {
    const void* weight;          // (P, W, 4 W), recurrent, transposed
    const unsigned char* reset;  // (P, T, B)
    const void* saved_gates;     // of the forward pass
    const float* saved_cells;
    const void* d_outputs;  // (P, T, B, W)
    const float* d_cell;    // (P, B, W); null: 0
    void* d_gates;          // (P, T, B, 4 W)
    float* d_bias;          // (P, C, 4 W), sums over each cluster's lanes
    float* d_last_output;   // (P, B, W)
    float* d_last_cell;     // (P, B, W)
    int n_policies;
    int n_steps;
    int n_lanes;
    int n_clusters;
};
