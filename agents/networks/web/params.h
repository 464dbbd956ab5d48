// The parameters of each launch, passed by value; see megastep/kernels/params.h.
//
// B lanes, A agents that one lane controls, n choices of each, W width. Strides count
// numbers from one lane to the next.
#pragma once

// One leaf of an observation, up to four axes behind the lanes, as columns of a matrix.
struct PolicyNormaliseParams {
    const unsigned char* obs;  // the first number, of any of the kinds below
    const float* mean;         // one per number, in the order of the axes, as scale
    const float* scale;
    float* out;
    int kind;  // 0: fp16, 1: float, 2: bytes, 3: long long
    int size0;
    int size1;
    int size2;
    int size3;
    int stride0;
    int stride1;
    int stride2;
    int stride3;
    int obs_stride;
    int out_stride;
    int choices;  // 0, or the number of columns of each integer, of which its own is 1
    int n_lanes;
};

struct PolicyLinearParams {
    const float* x;
    const float* weight;  // (n_out, n_in)
    const float* bias;    // (n_out) null: none
    float* out;
    int n_in;
    int n_out;
    int x_stride;
    int out_stride;
    int adds;        // 1: adds to what `out` holds
    int activation;  // 0: none, 1: relu, 2: tanh
    int n_lanes;
};

// A convolution with relu: images (A, C, H, W) to (A, C', H', W').
struct PolicyConvolveParams {
    const float* x;
    const float* weight;  // (C, kernel_h, kernel_w, C')
    const float* bias;    // (C')
    float* out;
    int n_images;  // A
    int n_in;      // C
    int height;
    int width;
    int n_out;  // C'
    int out_height;
    int out_width;
    int kernel_h;
    int kernel_w;
    int stride_h;
    int stride_w;
    int padding_h;
    int padding_w;
    int x_stride;
    int out_stride;
    int n_lanes;
};

struct PolicyClearParams {
    const unsigned char* reset;  // (B)
    float* state;                // (B, W)
    int width;
    int n_lanes;
};

// A step of a recurrent core after its products. Adds its outputs to x.
struct PolicyCellParams {
    const float* gates;  // (B, 4 W) of an LSTM, (B, 2 W) of a minGRU
    float* output;       // (B, W) the hidden state, in and out, as the next
    float* cell;         // (B, W) the LSTM's
    float* x;            // (B, W)
    int width;
    int n_lanes;
};

struct PolicyAddParams {
    const float* x;  // (n)
    float* out;      // (n)
    int n;
};

// Turns what an output's linear layer returns into log-probabilities and actions.
struct PolicyActParams {
    const float* scores;   // (B, A n)
    float* logits;         // (B, A n)
    long long* actions;    // (B, A)
    unsigned int* counts;  // (B) in and out: the generator's counter
    unsigned int key0;     // the seed
    unsigned int key1;
    int first;      // the first lane's number
    int n_agents;   // A
    int n_choices;  // n
    int greedy;     // 1: the most likely actions
    int n_lanes;
};
