// The parameters of the LSTM over a whole sequence on the CPU.
//
// T steps, B lanes, W units, a multiple of 16. Everything is float32. Gates are laid out as in
// params.h.
#pragma once

struct LstmSequenceForwardParams {
    const float* x;              // (T, B, W)
    const float* input_weight;   // (4 W, W)
    const float* bias;           // (4 W)
    const float* weight;         // (4 W, W) of the recurrent product
    const unsigned char* reset;  // (T, B) clears a lane's output and cell before the step
    const float* first_output;   // (B, W) before the sequence
    const float* first_cell;     // (B, W)
    float* gates;                // (T, B, 4 W) out: after activation
    float* hiddens;              // (T, B, W) out: the last step's output as a step sees it
    float* cells;                // (T, B, W) out: the last step's cell as a step sees it
    float* outputs;              // (T, B, W) out
    float* last_cell;            // (B, W) out
    int n_steps;
    int n_lanes;
    int width;
    int n_threads;
};

struct LstmSequenceBackwardParams {
    const float* input_weight;   // (4 W, W)
    const float* weight;         // (4 W, W)
    const unsigned char* reset;  // (T, B)
    const float* gates;          // (T, B, 4 W) after activation
    const float* cells;          // (T, B, W)
    const float* d_outputs;      // (T, B, W)
    const float* d_last_cell;    // (B, W)
    float* d_gates;              // (T, B, 4 W) out: before activation
    float* d_x;                  // (T, B, W) out
    float* d_output;             // (B, W) out: of the output before the sequence
    float* d_cell;               // (B, W) out
    int n_steps;
    int n_lanes;
    int width;
    int n_threads;
};
