// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// T steps, B lanes, W units. Arrays are bfloat16 unless their type says otherwise. C is the number
// of clusters, S = W / 64 that of blocks per cluster.
#pragma once

constexpr int SEQUENCE_THREADS = 256;  // threads of a block
constexpr int BLOCK_UNITS = 64;        // units of a block
// Lanes of a cluster. An H200 runs 30 clusters of four blocks at once: with 40 lanes they hold the
// 1,024 lanes of the default minibatch.
constexpr int SEQUENCE_LANES = 40;
constexpr int MAX_STEPS = 512;  // of a sequence
// Bytes of shared memory of a block, for 128 and for 256 units
constexpr int FORWARD_MEMORY_128 = 136608;
constexpr int BACKWARD_MEMORY_128 = 126880;
constexpr int FORWARD_MEMORY_256 = 159648;
constexpr int BACKWARD_MEMORY_256 = 216992;

struct LstmSequenceParams {
    const void* weight;          // recurrent: (4 W, W); backward: (W, 4 W), transposed
    const unsigned char* reset;  // (T, B)
    void* saved_gates;           // (T, C, S, 5, 256, 8), before activation; null: not saved
    float* saved_cells;          // (T, C, S, 5, 256, 2), each step's input
    int n_steps;
    int n_lanes;
    int n_clusters;
};

struct LstmSequenceForwardParams : LstmSequenceParams {
    const void* gates;         // (T, B, 4 W), products of the inputs, with the bias
    const float* last_output;  // (B, W), before the sequence
    const float* last_cell;    // (B, W)
    const void* residual;      // (T, B, W), added to the outputs; null: nothing is
    void* outputs;             // (T, B, W)
    void* hiddens;             // (T, B, W), each step's recurrent input
    float* output;             // (B, W), after the sequence, without the residual
    float* cell;               // (B, W), after the sequence
};

struct LstmSequenceBackwardParams : LstmSequenceParams {
    const void* d_outputs;  // (T, B, W)
    const float* d_cell;    // (B, W); null: 0
    void* d_gates;          // (T, B, 4 W)
    float* d_bias;          // (C, 4 W), sums over each cluster's lanes
    float* d_last_output;   // (B, W)
    float* d_last_cell;     // (B, W)
};
