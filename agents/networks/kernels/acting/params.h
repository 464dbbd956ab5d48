// The parameters of each launch, passed by value; see megastep/kernels/params.h.
// B lanes, W units, a multiple of 64.
#pragma once

constexpr int LANES = 128;    // of a block
constexpr int ROWS = 128;     // of the weights, of a block
constexpr int INNER = 64;     // numbers of the product's inner axis at once, a part
constexpr int STAGES = 3;     // parts in shared memory
constexpr int THREADS = 256;  // of a block

// One step of the minGRU (G = 2 gates: update, candidate) or of the LSTM (G = 4: input, forget,
// candidate, output). The inner axis of the weights has K = W numbers, those of x, or K = 2 W,
// those of x and of the last output.
struct StepParams {
    const void* x;               // (B, W) bfloat16
    const void* last_output;     // (B, W) bfloat16; null: the minGRU
    const void* weight;          // (G W, K) bfloat16
    const void* bias;            // (G W) bfloat16
    const unsigned char* reset;  // (B)
    const float* last_state;     // (B, W) the minGRU's state, or the LSTM's cell
    void* outputs;               // (B, W) bfloat16
    void* next_output;           // (B, W) bfloat16, without the residual; null: the minGRU
    float* next_state;           // (B, W)
    int n_lanes;                 // B
    int width;                   // W
    int is_residual;             // 1: adds x to `outputs`. 0: does not
};
